"""Disks that are small, full or read-only, for real: mounted for one command alone."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

QUICK = ("--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "60", "--headless")
ENDLESS = "virtual:ball?size=160x120&frames=1000000"
MIB = 1 << 20


ALONE = ("unshare", "--user", "--map-root-user", "--mount")


def can_mount() -> bool:
    """Whether this user may mount for itself alone, as Linux lets most."""
    trial = [*ALONE, "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return bool(shutil.which("unshare")) and not subprocess.run(trial, capture_output=True).returncode


pytestmark = pytest.mark.skipif(not can_mount(), reason="mounting a small disk takes Linux with user namespaces")


class Disk:
    """A command with a disk of its own, in a mount namespace that ends with it."""

    def __init__(self, folder: Path, options: str, *arguments: str) -> None:
        mount = f"mount -t tmpfs -o {options} tmpfs '{folder}' || exit 9"
        command = [sys.executable, "-m", "selective_depth.app", *arguments, *QUICK]
        # The shell stays after the command, and the disk with it, until its input ends.
        script = f'{mount}; "$@" 2>&1; echo "exit code $?"; read end'
        self.process = subprocess.Popen(
            [*ALONE, "sh", "-c", script, "sh", *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.folder = Path(f"/proc/{self.process.pid}/root{folder}")

    def finish(self) -> str:
        """What it printed, with its exit code."""
        assert self.process.stdout is not None
        lines: list[str] = []
        for line in self.process.stdout:
            lines.append(line)
            if line.startswith("exit code"):
                break
        return "".join(lines)


@contextmanager
def disk(folder: Path, options: str, *arguments: str) -> Iterator[Disk]:
    made = Disk(folder, options, *arguments)
    try:
        yield made
    finally:
        made.process.communicate()


@pytest.mark.parametrize(
    ("options", "reason"), [("size=1m", "1 MiB are free there"), ("ro", "cannot be written: Read-only file system")]
)
def test_a_disk_without_room_is_refused_at_once(tmp_path: Path, options: str, reason: str) -> None:
    saving = ("replay", ENDLESS, "--save", str(tmp_path / "out.rrd"))
    with disk(tmp_path, options, *saving) as small:
        said = small.finish()
        assert "exit code 1" in said
        assert reason in said
        assert not list(small.folder.iterdir())


def depths_in(saved: Path) -> int:
    chunks = RrdReader(str(saved)).stream()
    return sum(chunk.num_rows for chunk in chunks if chunk.entity_path == "/camera/depth")


def test_a_disk_that_fills_leaves_a_whole_file(tmp_path: Path) -> None:
    saving = ("replay", ENDLESS, "--save", str(tmp_path / "out.rrd"))
    with disk(tmp_path, "size=140m", *saving) as small:
        saved = small.folder / "out.rrd"
        deadline_s = time.monotonic() + 60
        while not saved.exists() or saved.stat().st_size < MIB:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        with (small.folder / "ballast").open("wb", buffering=0) as file:
            while shutil.disk_usage(small.folder).free > 50 * MIB:
                file.write(bytes(MIB))
        said = small.finish()
        assert "exit code 1" in said
        assert "the disk is full" in said
        assert depths_in(saved) > 5


def test_a_write_that_fails_leaves_what_was_written_before(tmp_path: Path) -> None:
    saved = tmp_path / "out.rrd"
    command = [sys.executable, "-m", "selective_depth.app", "replay", ENDLESS, "--save", str(saved)]
    done = subprocess.run(
        ["sh", "-c", 'ulimit -f 40960; exec "$@"', "sh", *command, *QUICK],  # blocks of 512 bytes
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1, done.stderr
    kept = re.search(r"failed after ([\d,]+) bytes, which are kept", done.stderr)
    assert kept is not None, done.stderr
    assert saved.stat().st_size == int(kept[1].replace(",", "")) > 0
    assert depths_in(saved) > 5
