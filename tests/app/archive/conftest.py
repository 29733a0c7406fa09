"""An archive of sixty small recordings, and the results of a run over it."""

from __future__ import annotations

from pathlib import Path

import pytest
from archives import QUICK, Archive, Done, batch, halve, write


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Archive:
    """Sixty: .oni files and folders of PNG files, two damaged, one empty, one with colour."""
    path, frames = tmp_path_factory.mktemp("archive") / "lab", {}
    for number in range(57):
        scene = ("ball", "workstation", "firehose")[number % 3]
        name = f"day{number % 4}/{scene}-{number}" + (".oni" if number % 2 else "")
        frames[f"lab/{name}"] = 3 + number % 4
        write(path / name, scene, 3 + number % 4, number, colour=number == 0)
    write(path / "day1" / "cut.oni", "ball", 6, 99)
    halve(path / "day1" / "cut.oni")
    write(path / "day2" / "torn", "ball", 6, 98)
    halve(path / "day2" / "torn" / "000004.png")
    (path / "day3" / "nothing").mkdir()
    return Archive(path, frames)


@pytest.fixture(scope="session")
def undisturbed(archive: Archive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """The results of a run that nothing came between."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    return out, batch(archive.path, "--out", out, *QUICK)
