"""Writing results: refused before the work, or whole or not at all, with one sentence."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.output import IMAGES, check_output, check_picture, replacing, write_image, write_output
from selective_depth.drivers.errors import OutputError

IMAGE = np.tile(np.arange(48, dtype=np.uint8)[:, None, None], (1, 64, 3))


@pytest.mark.parametrize("name", ["a.png", "b.webp", "C.PNG"])
def test_a_picture_reads_back(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_image(tmp_path / name, IMAGE)
    read = cv2.imread(str(tmp_path / name))
    assert read is not None
    assert np.abs(read.astype(int) - IMAGE).max() <= 3
    assert capfd.readouterr().err == ""


def test_other_kinds_and_missing_folders_are_refused_early(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"must end in \.png, \.webp, \.pdf or \.svg"):
        check_picture(tmp_path / "a.gif")
    with pytest.raises(UsageError, match=r"must end in \.png or \.webp"):
        check_picture(tmp_path / "a.pdf", IMAGES)
    with pytest.raises(OutputError, match="folder does not exist"):
        check_picture(tmp_path / "no" / "a.png")
    with pytest.raises(OutputError, match="folder does not exist"):
        check_output(None, tmp_path / "no" / "a.json")
    check_output(None, tmp_path / "a.json")


def test_what_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="Is a directory"):
        write_output(tmp_path, "text")
    (tmp_path / "file").write_text("older")
    with pytest.raises(OutputError, match="Not a directory"):
        write_output(tmp_path / "file" / "x", "text")


def test_an_older_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_output(file, "older")
    file.chmod(0o640)
    with pytest.raises(KeyboardInterrupt), replacing(file) as new:
        new.write(b"half")
        new.flush()
        assert file.read_text() == "older"
        raise KeyboardInterrupt
    assert file.read_text() == "older"
    write_output(file, "newer")
    assert file.read_text() == "newer"
    assert list(tmp_path.iterdir()) == [file]
    if sys.platform != "win32":
        assert stat.S_IMODE(file.stat().st_mode) == 0o640


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes are POSIX's")
def test_links_stay_links_and_pipes_are_written_into(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("older")
    (tmp_path / "link").symlink_to("there")
    write_output(tmp_path / "link", "newer")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there").read_text() == "newer"
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    write_output(pipe, "through")
    reader.join(10)
    assert read == ["through"]
    write_output(Path(os.devnull), "away")
    assert not Path(os.devnull).is_file()


FULL = """
mount -t tmpfs -o size=1m none "$1" && cd "$1" || exit 99
printf older > out.json; mkdir model; printf older > model/cloud.ply
head -c 900000 /dev/zero > ballast
shift
"$@"; code=$?
rm ballast
find . -type f | sort; cat out.json model/cloud.ply
exit $code
"""


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[list[str]]:
    """How to run a command on a disk of 1 MB that is all but full, seen by that command alone."""
    unshare = shutil.which("unshare")
    own = [unshare or "", "--map-root-user", "--mount"]
    trial = [*own, "mount", "-t", "tmpfs", "none", str(tmp_path)]
    if unshare is None or subprocess.run(trial, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here: that needs root, or Linux's user namespaces")
    yield [*own, "sh", "-c", FULL, "sh", str(tmp_path)]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["model", "virtual:ball?frames=1", "model"], "model/cloud.ply"),
        (["snapshot", "virtual:ball?frames=1", "--out", "pictures"], "pictures/sheet.png"),
        (["snapshot", "virtual:ball?frames=1", "--out", "sheet.pdf"], "sheet.pdf"),
    ],
)
def test_on_a_full_disk_older_files_stay_whole_and_nothing_is_left(
    arguments: list[str], name: str, full_disk: list[str]
) -> None:
    program = [*full_disk, sys.executable, "-m", "selective_depth.app", *arguments]
    done = subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1, done.stderr
    sentence = f"'{name}' cannot be written: No space left on device. Make room there"
    assert sentence in done.stderr
    assert done.stdout == "./model/cloud.ply\n./out.json\nolderolder"
