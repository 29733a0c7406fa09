"""Finding the OpenNI2 runtime, and what the USB bus says where it finds no sensor."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from selective_depth.drivers.errors import RuntimeMissingError
from selective_depth.drivers.openni.runtime import find_runtime
from selective_depth.drivers.openni.usb import usb_advice


@pytest.fixture(autouse=True)
def _no_chosen_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENNI2_REDIST", raising=False)
    monkeypatch.delenv("OPENNI2_REDIST64", raising=False)


@pytest.mark.parametrize("variable", ["OPENNI2_REDIST", "OPENNI2_REDIST64"])
@pytest.mark.parametrize("name", ["libOpenNI2.so", "libOpenNI2.so.0"])
def test_a_chosen_runtime_is_the_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, name: str) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    (tmp_path / name).touch()
    drivers = tmp_path / "OpenNI2" / "Drivers"
    drivers.mkdir(parents=True)
    for driver in ("libPS1080.so.0", "libFreenectDriver.so.0", "libOniFile.so.0"):
        (drivers / driver).touch()
    monkeypatch.setenv(variable, str(tmp_path))
    runtime = find_runtime()
    assert runtime.path == tmp_path / name
    assert runtime.drivers == ("FreenectDriver", "PS1080")


def test_a_chosen_folder_without_runtime_is_not_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(RuntimeMissingError, match=f"OPENNI2_REDIST names {tmp_path}"):
        find_runtime()


@pytest.mark.parametrize(
    ("system", "library", "remedy"),
    [
        ("linux", "libOpenNI2.so.0", "sudo apt install libopenni2-0"),
        ("darwin", "libOpenNI2.dylib", "brew install openni2"),
        ("win32", "OpenNI2.dll", "OpenNI 2.2 SDK"),
    ],
)
def test_each_system_has_its_remedy(monkeypatch: pytest.MonkeyPatch, system: str, library: str, remedy: str) -> None:
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setenv("ProgramFiles", "C:/Program Files")
    monkeypatch.setattr(Path, "is_file", lambda _: False)
    with pytest.raises(RuntimeMissingError, match=remedy) as caught:
        find_runtime()
    assert library in str(caught.value)
    assert "looked in" in str(caught.value)


def plug_in(root: Path, port: str, vendor: str, product: str, device: int) -> Path:
    folder = root / "sys" / port
    folder.mkdir(parents=True)
    for name, value in (("idVendor", vendor), ("idProduct", product), ("busnum", "1"), ("devnum", str(device))):
        (folder / name).write_text(value + "\n")
    (root / "sys" / f"{port}:1.0").mkdir()  # an interface has no numbers of its own
    node = root / "dev" / "001" / f"{device:03}"
    node.parent.mkdir(parents=True, exist_ok=True)
    node.touch()
    return node


def advice(root: Path, *drivers: str) -> str:
    return usb_advice(drivers, root / "sys", root / "dev")


def test_a_kinect_without_driver(tmp_path: Path) -> None:
    plug_in(tmp_path, "1-2", "045e", "02ae", 5)
    assert "no driver for it (it has: PS1080)" in advice(tmp_path, "PS1080")


def test_a_sensor_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = plug_in(tmp_path, "1-2", "1d27", "0601", 7)
    monkeypatch.setattr("os.access", lambda path, _: path != node)
    assert f"may not use it ({node})" in advice(tmp_path, "PS1080")


def test_a_sensor_that_another_program_uses(tmp_path: Path) -> None:
    plug_in(tmp_path, "1-2", "1d27", "0601", 7)
    assert "close the program" in advice(tmp_path, "PS1080")


def test_a_kinect_without_power(tmp_path: Path) -> None:
    plug_in(tmp_path, "1-2", "045e", "02b0", 5)
    assert "power supply" in advice(tmp_path, "FreenectDriver")


def test_a_bus_without_sensor(tmp_path: Path) -> None:
    plug_in(tmp_path, "1-1", "1d6b", "0002", 1)
    assert advice(tmp_path, "PS1080") == ""
    assert usb_advice((), tmp_path / "no bus") == ""
