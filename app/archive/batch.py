"""Every recording of an archive, spread over workers: what is under way, what is done, what failed."""

from __future__ import annotations

import glob
import hashlib
import re
import shutil
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from selective_depth.app.archive.engine import Stream
from selective_depth.app.archive.table import SCHEMA, SUMMARY, schema_of
from selective_depth.app.archive.unit import WORK, Cut, Job, Recording, do_range, do_recording, join
from selective_depth.app.console import interrupt
from selective_depth.app.console.dispatch import sentence_of
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.console.output import lock, make_folder
from selective_depth.app.console.tables import write_table
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.options import parted
from selective_depth.drivers.search import find_recordings

if TYPE_CHECKING:
    from distributed import Client

TICK_S = 0.5
"""How often progress is looked at."""
SUMMARY_FILE = "summary.parquet"


def recordings(words: Iterable[str], out: Path | None = None) -> Iterator[Recording]:
    """All recordings that the given words name, one by one: files, folders, patterns, ``-`` for a list on stdin.

    The name of a recording is its path from the folder that was given, that folder's name
    included. Where two sources have the same name, eight letters are added to the second's, always the same ones.

    Raises
    ------
    UsageError
        If nothing matches a pattern.
    """
    named: set[str] = set()
    known: set[str] = set()
    for word in _expanded(words):
        path, options = parted(word)
        local = Path(path).exists()
        base = Path(path).absolute()
        name = base.resolve().name or "root" if local else re.sub(r"[^\w.+=-]+", "_", word)[:150]
        if word in known:
            continue
        known.add(word)
        if name in named:
            name += "-" + hashlib.sha256(f"{base}?{options}".encode(errors="surrogateescape")).hexdigest()[:8]
        named.add(name)
        for found in find_recordings(f"{base}?{options}" if options and local else str(base) if local else word, out):
            inner = Path(parted(found)[0]).relative_to(base).as_posix() if local else "."
            yield Recording(found, name if inner == "." else f"{name}/{inner}")


def _expanded(words: Iterable[str]) -> Iterator[str]:
    for word in words:
        if word == "-":
            yield from _expanded(line for each in sys.stdin if (line := each.rstrip("\n")) not in ("", "-"))
        elif not re.search(r"[*[]|\?(?!\w+=)", word) or Path(parted(word)[0]).exists():
            yield word
        else:
            pattern, options = re.fullmatch(r"(.*?)(\?\w+=.*)?", word, re.S).groups("")  # type: ignore[union-attr]
            matched = sorted(glob.iglob(pattern, recursive=True))  # noqa: PTH207 - it may be absolute
            if not matched:
                raise UsageError(f"nothing matches '{pattern}'; check the pattern.")
            yield from (each + options for each in matched)


class Batch:
    """A run over an archive.

    Parameters
    ----------
    job : Job
        What is done with every recording.
    words : sequence of str
        As for `recordings`.
    failed : callable, optional
        Called with the row of the summary of each recording that is not whole.

    Attributes
    ----------
    listed, done, skipped, failures : int
        Recordings found so far; done, of them done before; not whole.
    frames : int
        Frames made by this run.
    complete : bool
        Whether all recordings have been found.
    """

    def __init__(
        self, job: Job, words: Sequence[str], failed: Callable[[dict[str, Any]], None] = lambda row: None
    ) -> None:
        self.job = job
        self.listed = self.done = self.skipped = self.failures = 0
        self.complete = self._unfinished = False
        self._words, self._failed = words, failed
        self._waiting: deque[Recording] = deque()
        self._trouble: BaseException | None = None
        self._made = 0
        self._heard: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._tables: list[pa.Table] = []

    @property
    def frames(self) -> int:
        """Frames made by this run, those of recordings under way included."""
        return self._made + sum(list(self._heard.values()))

    def run(self, client: Client, progress: Callable[[Stream], None] = lambda stream: None) -> pa.Table:
        """Do all of it; returns the summary, sorted by name, which is in ``summary.parquet`` as well.

        Raises
        ------
        OutputError, AppError
            What ends the whole run: a full disk, an option out of its range.
        """
        out = self.job.out
        make_folder(out / WORK)
        with (out / WORK / "lock").open("ab") as held:
            if not lock(held):
                raise UsageError(f"another run writes to '{out}'; wait for it, or name another --out.")
            return self._run(client, out, progress)

    def _run(self, client: Client, out: Path, progress: Callable[[Stream], None]) -> pa.Table:
        for left in out.rglob(".????????????.part"):  # of a run that was killed
            with suppress(OSError):
                left.unlink()
        stream = Stream(client, lambda told: self._heard.update([told]))
        threading.Thread(target=self._list, name="listing", daemon=True).start()
        while True:
            complete = self.complete  # looked at first: once it is set, no more are added
            while self._waiting and not stream.full:
                recording = self._waiting.popleft()
                stream.submit(do_recording, self.job, recording, tag=partial(self._take, stream, recording))
            if complete and not self._waiting:
                if self._trouble is not None:
                    raise self._trouble
                if not len(stream):
                    break
            for take, result in stream.finished(TICK_S if len(stream) else 0.01):
                if isinstance(result, (OutputError, AppError)):
                    raise result
                take(result)
            interrupt.check()
            progress(stream)
        self._flush()
        summary = pa.concat_tables(self._tables).sort_by("recording")
        write_table(out / SUMMARY_FILE, summary, SCHEMA)
        if not self._unfinished:  # whose ranges are kept for the next run
            shutil.rmtree(out / WORK, ignore_errors=True)
        return summary

    def _list(self) -> None:
        """Find the recordings, while work on the first of them has begun already."""
        try:
            for each in recordings(self._words, self.job.out):
                self._waiting.append(each)
                self.listed += 1
        except BaseException as error:  # noqa: BLE001 - raised again where it is waited for
            self._trouble = error
        self.complete = True

    def _take(self, stream: Stream, recording: Recording, result: Any) -> None:
        """Take in a result: a recording is done, or its ranges are joined, or it is to be cut into ranges."""
        if isinstance(result, Cut):
            ranges: list[Any] = [None] * len(result.starts)
            for at in range(len(ranges)):
                take = partial(self._take_range, stream, recording, result, ranges, at)
                stream.submit(do_range, self.job, recording, result, at, tag=take)
            return
        row = _row_of(recording, result)
        self._heard.pop(f"{recording.name} 0", None)
        self.done += 1
        before = row.pop("done_before", False)
        self.skipped += before
        self._made += 0 if before else row["frames"]
        self._rows.append(row)
        if len(self._rows) == 1000:
            self._flush()
        if row["failure"]:
            self.failures += 1
            self._failed(row)

    def _take_range(
        self, stream: Stream, recording: Recording, cut: Cut, ranges: list[Any], at: int, result: Any
    ) -> None:
        """Take in a range, perhaps the last of its recording."""
        ranges[at] = _row_of(recording, result)
        self._unfinished |= isinstance(result, Exception)
        self._heard[f"{recording.name} {cut.starts[at]}"] = ranges[at]["frames"]
        if all(ranges):
            for start in cut.starts:
                self._heard.pop(f"{recording.name} {start}", None)
            stream.submit(join, self.job, recording, cut, ranges, tag=partial(self._take, stream, recording))

    def _flush(self) -> None:
        """Hold what is done in columns: some hundred bytes a recording."""
        self._tables.append(pa.Table.from_pylist(self._rows, schema=schema_of(SUMMARY)))
        self._rows.clear()


def _row_of(recording: Recording, result: Any) -> dict[str, Any]:
    """The row of the summary that a call came to, or what ended it."""
    if not isinstance(result, Exception):
        return dict(result)
    sentence = sentence_of(result)
    if type(result).__name__ == "KilledWorker":
        sentence = "its worker ended each time it was tried; is there enough memory?"
    row = {"recording": recording.name, "source": recording.source, "state": "failed", "frames": 0}
    return row | {"failure": sentence, "work_s": 0.0, "unfinished": True}
