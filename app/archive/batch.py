"""Every recording of an archive, spread over workers: what is under way, what is done, what failed."""

from __future__ import annotations

import glob
import hashlib
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from selective_depth.app.archive.engine import Stream
from selective_depth.app.archive.table import SCHEMA, SUMMARY, schema_of
from selective_depth.app.archive.unit import WORK, Cut, Job, Recording, do_range, do_recording, join
from selective_depth.app.console import interrupt
from selective_depth.app.console.dispatch import sentence_of
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.console.output import cannot_write, lock, make_folder
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
    """All recordings that some words name, one by one: files, folders, patterns, ``-`` for a list on stdin.

    The name of a recording is its path from the folder that was given, that folder's name
    included. Where two sources have one name, the second has eight letters more, always the same.

    Raises
    ------
    UsageError
        If a pattern fits nothing.
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
                raise UsageError(f"nothing fits '{pattern}'; check the pattern.")
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
        self._made, self._heard = 0, {}  # type: tuple[int, dict[str, int]]
        self._trouble: BaseException | None = None
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
            What ends all of it: a full disk, an option out of its range.
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
        source = self._listing()
        ends = False
        while not ends or len(stream):
            while not ends and not stream.full:
                recording = next(source, None)
                ends = recording is None and self.complete
                if recording is None:
                    break
                stream.submit(do_recording, self.job, recording, tag=(recording, None, -1))
            for tag, result in stream.finished(TICK_S if len(stream) else 0.01):
                self._take(stream, result, *tag)
            interrupt.check()
            progress(stream)
        self._flush()
        summary = pa.concat_tables([schema_of(SUMMARY).empty_table(), *self._tables]).sort_by("recording")
        write_table(out / SUMMARY_FILE, summary, SCHEMA)
        if not self._unfinished:  # whose ranges are kept for the next run
            shutil.rmtree(out / WORK, ignore_errors=True)
        return summary

    def _listing(self) -> Iterator[Recording | None]:
        """Recordings as they are found; None while the next one is not. The list waits in a file, however long."""
        path = self.job.out / WORK / "list"

        def write() -> None:
            try:
                with path.open("w", encoding="utf-8", errors="surrogateescape", buffering=1) as list_:
                    for each in recordings(self._words, self.job.out):
                        list_.write("\0".join(each).replace("\n", "\1") + "\n")
                        self.listed += 1
            except OSError as error:
                self._trouble = cannot_write(path, error)
            except BaseException as error:  # noqa: BLE001 - raised again where it is waited for
                self._trouble = error
            self.complete = True

        path.touch()
        threading.Thread(target=write, name="listing", daemon=True).start()
        with path.open(encoding="utf-8", errors="surrogateescape", newline="\n") as list_:
            given, line = 0, ""
            while True:
                over = self.complete  # before the last look
                line += list_.readline()
                if line.endswith("\n"):
                    yield Recording(*line[:-1].replace("\1", "\n").split("\0"))
                    given, line = given + 1, ""
                elif over:
                    break
                else:
                    yield None
        if self._trouble is not None:
            raise self._trouble

    def _take(self, stream: Stream, result: Any, recording: Recording, cut: Any, at: int) -> None:
        """One call is done: a recording, or one of its ranges, or their joining."""
        if isinstance(result, (OutputError, AppError)):
            raise result
        if isinstance(result, Cut):
            ranges: list[Any] = [None] * len(result.starts)
            for number in range(len(ranges)):
                stream.submit(do_range, self.job, recording, result, number, tag=(recording, (result, ranges), number))
            return
        if isinstance(result, Exception):
            sentence = sentence_of(result)
            if type(result).__name__ == "KilledWorker":
                sentence = "its worker ended each time it was tried; is there enough memory?"
            result = {"recording": recording.name, "source": recording.source, "state": "failed", "frames": 0}
            result |= {"failure": sentence, "work_s": 0.0, "unfinished": True}
            self._unfinished |= at >= 0
        if cut is not None and at >= 0:
            self._heard[f"{recording.name} {cut[0].starts[at]}"] = result["frames"]
            cut[1][at] = result
            if all(cut[1]):
                for start in cut[0].starts:
                    self._heard.pop(f"{recording.name} {start}", None)
                stream.submit(join, self.job, recording, *cut, tag=(recording, cut, -1))
            return
        self._heard.pop(f"{recording.name} 0", None)
        self.done += 1
        before = result.pop("done_before", False)
        self.skipped += before
        self._made += 0 if before else result["frames"]
        self._rows.append(result)
        if len(self._rows) == 1000:
            self._flush()
        if result["failure"]:
            self.failures += 1
            self._failed(result)

    def _flush(self) -> None:
        """Hold what is done in columns: some hundred bytes a recording."""
        self._tables.append(pa.Table.from_pylist(self._rows, schema=schema_of(SUMMARY)))
        self._rows.clear()
