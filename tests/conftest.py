"""What the tests share."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from virtual_sensor import RigMissingError, VirtualSensor, build_driver, record_oni

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real sensor frames; they are third-party research data and not part of the project."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real sensor frames: {folder.name} is not beside the project")
    return folder


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """Inputs that once went wrong; others' data, and not part of the project."""
    folder = ROOT.parent / "shared" / "cases"
    if not folder.is_dir():
        pytest.skip(f"no inputs that went wrong: {folder.name} is not beside the project")
    return folder


@pytest.fixture(scope="session")
def virtual_driver() -> Path:
    """The virtual sensor's driver for the real OpenNI2 runtime, compiled."""
    try:
        return build_driver()
    except RigMissingError as error:
        pytest.skip(str(error))


@pytest.fixture
def virtual_sensor(virtual_driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> VirtualSensor:
    """A sensor attached to this process's OpenNI2, which sees no other.

    Its frame k (from 0, round and round after 20) is k + 1 on the right and k + 1001 on the left.
    """
    frames = np.zeros((20, 480, 640), np.uint16) + np.arange(1, 21, dtype=np.uint16)[:, None, None]
    frames[:, :, :320] += 1000
    sensor = VirtualSensor(tmp_path / "sensor", frames)
    for name, value in sensor.env.items():
        monkeypatch.setenv(name, value)
    return sensor


@dataclass(frozen=True)
class OniSample:
    """A real recording, and what is in it."""

    path: Path
    depth_mm: npt.NDArray[np.uint16]


@pytest.fixture(scope="session")
def oni_sample(virtual_driver: Path, tmp_path_factory: pytest.TempPathFactory) -> OniSample:
    """An `.oni` made by the real OpenNI2 recorder: 12 frames, 640x480, with noise and holes."""
    draw = np.random.default_rng(0)
    rows, columns = np.mgrid[0:480, 0:640]
    depth = 500 + 3 * columns + 5 * rows + 100 * np.arange(12)[:, None, None]
    depth = depth + draw.integers(-20, 20, depth.shape)
    depth[draw.random(depth.shape) < 0.1] = 0
    depth[:, 0, :3] = (1, 9999, 0)
    frames = depth.astype(np.uint16)
    path = tmp_path_factory.mktemp("oni") / "sample.oni"
    record_oni(frames, path)
    return OniSample(path, frames)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of one megabyte, to be filled."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to mount a file system here; root has it")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """In CI everything needed is installed, so a skipped test is a broken CI."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter is not None else []
    if os.environ.get("CI") and skipped and exitstatus == pytest.ExitCode.OK:
        reporter.write_line(f"{len(skipped)} tests skipped, and in CI none may be", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
