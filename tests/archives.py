"""How the tests of archives make recordings, run the command `batch` and compare its tables."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from selective_depth.app.console.interrupt import LEAVE_S
from selective_depth.drivers.folder import FolderWriter
from selective_depth.drivers.oni import OniWriter
from selective_depth.drivers.open import open_source

QUICK = ("--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "200", "--budget", "5%")
START = (sys.executable, "-m", "selective_depth.app")
TIMES = re.compile(r"_ms$|_s$")


def write(path: Path, scene: str, frames: int, seed: int, colour: bool = False, size: str = "64x48") -> None:
    """A recording of a made scene."""
    path.parent.mkdir(parents=True, exist_ok=True)
    uri = f"virtual:{scene}?frames={frames}&seed={seed}&size={size}{'' if colour else '&colour=off'}"
    writer = (OniWriter if path.suffix == ".oni" else FolderWriter)(path, fps=30.0)
    with open_source(uri) as source, writer:
        for frame in source:
            writer.write(frame)


def halve(path: Path) -> None:
    """A file that was cut."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@dataclass(frozen=True)
class Archive:
    """Where it is, and how many frames each whole recording has."""

    path: Path
    frames: dict[str, int]


def start(*words: str | Path, cwd: Path | None = None, stdin: str | None = None) -> subprocess.Popen[str]:
    """The command `batch`, in a group of its own."""
    process = subprocess.Popen(
        [*START, "batch", *map(str, words)],
        stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=cwd,
    )
    if stdin is not None and process.stdin is not None:
        process.stdin.write(stdin)
        process.stdin.close()
        process.stdin = None
    return process


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    code: int
    out: str
    err: str


def finish(process: subprocess.Popen[str], timeout_s: float = 240) -> Done:
    """Wait for it."""
    out, err = process.communicate(timeout=timeout_s)
    return Done(process.returncode, out, err)


def batch(*words: str | Path, stdin: str | None = None) -> Done:
    """The command `batch`, to its end."""
    return finish(start(*words, stdin=stdin))


def wait_for(there: Callable[[], bool], timeout_s: float = 120) -> None:
    """Wait until something is there."""
    end_s = time.monotonic() + timeout_s
    while not there():
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.02)


def tables(out: Path) -> dict[str, pa.Table]:
    """All tables but for their times, by name."""
    found = {}
    for path in sorted(out.rglob("*.parquet")):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if not TIMES.search(name)]
        found[path.relative_to(out).as_posix()] = table.select(kept).replace_schema_metadata()
    return found


def same(one: dict[str, pa.Table], other: dict[str, pa.Table]) -> None:
    """Hold tables against others."""
    assert list(one) == list(other)
    for name, table in one.items():
        assert table.equals(other[name]), name


def children(pid: int) -> list[int]:
    """Processes of Dask that a client started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"spawn_main" in (stat.parent / "cmdline").read_bytes():
                found.append(int(stat.parent.name))
        except OSError:  # it has ended
            continue
    return found


def kill(process: subprocess.Popen[str]) -> None:
    """End a client as a power cut would, and wait until its workers have noticed."""
    workers = children(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), LEAVE_S * 5)
