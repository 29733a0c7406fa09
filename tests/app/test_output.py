"""Writing results: refused before the work, or with one sentence after it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.output import (
    check_output,
    check_picture,
    write_output,
    write_picture,
)
from selective_depth.drivers.errors import OutputError

IMAGE = np.tile(np.arange(48, dtype=np.uint8)[:, None, None], (1, 64, 3))


@pytest.mark.parametrize("name", ["a.png", "b.webp", "C.PNG"])
def test_a_picture_reads_back(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_picture(tmp_path / name, IMAGE)
    read = cv2.imread(str(tmp_path / name))
    assert read is not None
    assert np.abs(read.astype(int) - IMAGE).max() <= 3
    assert capfd.readouterr().err == ""


def test_other_kinds_and_missing_folders_are_refused_early(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.png or \.webp"):
        check_picture(tmp_path / "a.gif")
    with pytest.raises(OutputError, match="folder does not exist"):
        check_picture(tmp_path / "no" / "a.png")
    with pytest.raises(OutputError, match="folder does not exist"):
        check_output(None, tmp_path / "no" / "a.json")
    check_output(None, tmp_path / "a.json")


def test_what_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="Is a directory"):
        write_output(tmp_path, "text")
