"""Every message in the README's table of troubles is provoked, word for word."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.app import cli

ROOT = Path(__file__).parents[2]
BALL = "virtual:ball?size=160x120&frames=1"
Provoke = Callable[[Path, pytest.MonkeyPatch], list[str]]


def no_runtime(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setenv("OPENNI2_REDIST", str(folder))
    return ["live", "--headless"]


def text_as_recording(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    (folder / "a.oni").write_text("hello")
    return ["replay", str(folder / "a.oni"), "--headless"]


def eight_bits(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    cv2.imwrite(str(folder / "0.png"), np.ones((48, 64), np.uint8))
    return ["replay", str(folder), "--headless"]


def two_sizes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    cv2.imwrite(str(folder / "0.png"), np.ones((480, 640), np.uint16))
    cv2.imwrite(str(folder / "1.png"), np.ones((240, 320), np.uint16))
    return ["replay", str(folder), "--headless"]


def which_scale(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth" / "1.5.png"), np.full((48, 64), 900, np.uint16))
    (folder / "depth.txt").write_text("1.5 depth/1.5.png\n")
    return ["replay", str(folder), "--headless"]


def nobody_listens(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    return ["replay", BALL, "--headless", "--connect", f"rerun+http://127.0.0.1:{port}/proxy"]


def no_display(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.chdir(folder)
    return ["replay", BALL, "--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "50"]


def dead_display(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    arguments = no_display(folder, monkeypatch)
    monkeypatch.setenv("DISPLAY", ":4321")
    return arguments


PROVOKED: dict[str, Provoke] = {
    "The OpenNI2 runtime … was not found": no_runtime,
    "OpenNI2 finds no depth sensor": lambda folder, patch: ["live", "--headless"],
    "There is no sensor '…'": lambda folder, patch: ["live", "nowhere", "--headless"],
    "'…' has no readable frame": text_as_recording,
    "no depth frames in '…'": lambda folder, patch: ["replay", str(folder), "--headless"],
    "… is an 8-bit grey PNG": eight_bits,
    "… pixels, but this recording is …": two_sizes,
    "the scale of '…' is not known": which_scale,
    "'…' cannot be written": lambda folder, patch: [
        "replay", BALL, "--headless", "--save", str(folder / "no" / "x.rrd")
    ],
    "no viewer listens at …": nobody_listens,
    "No display here": no_display,
    "The viewer window does not start": dead_display,
}  # fmt: skip
ELSEWHERE = {"… opens, but sent no frame"}
"""Takes ten seconds and a silent sensor: `tests/drivers/openni/test_vices.py`."""
WITH_OPENNI2 = {"OpenNI2 finds no depth sensor", "There is no sensor '…'"}


def test_the_table_holds_what_is_provoked_here() -> None:
    section = (ROOT / "README.md").read_text().partition("## When something goes wrong")[2]
    table = section.partition("\n## ")[0]
    assert set(re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)) == set(PROVOKED) | ELSEWHERE


@pytest.mark.parametrize(
    "message", [pytest.param(each, marks=[pytest.mark.openni] if each in WITH_OPENNI2 else []) for each in PROVOKED]
)
def test_it_says_so(
    message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    code = cli.run(PROVOKED[message](tmp_path, monkeypatch))
    said = capfd.readouterr()
    pattern = ".*".join(re.escape(part) for part in message.split("…"))
    assert re.search(pattern, said.out + said.err), said
    assert (code == 0) == (message in ("No display here", "The viewer window does not start"))
    assert "Traceback" not in said.err
