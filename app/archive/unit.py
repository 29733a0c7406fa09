"""A unit of work: a recording, or a range of its frames, from its source to its table.

Whichever worker does it, and however often, the result is the same except for the times.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from selective_depth.app import __version__
from selective_depth.app.archive.engine import tell
from selective_depth.app.archive.table import SCHEMA, FigureTable, found_done, row_of, rows_of, writing
from selective_depth.app.console.dispatch import sentence_of
from selective_depth.app.console.errors import AppError
from selective_depth.app.pipeline import Feed, FrameResult, Pipeline
from selective_depth.app.settings import Settings
from selective_depth.drivers.errors import OutputError, SourceError
from selective_depth.drivers.open import open_source
from selective_depth.drivers.options import parted
from selective_depth.drivers.source import DepthSource

RANGE_FRAMES = 300
"""A recording that can be cut is cut into ranges of at least this many frames."""
MOST_RANGES = 16
"""Into this many at most: .oni files are read from their beginning for every range."""
TELL_S = 2.0
WORK = ".batch"
"""Folder in --out for what is not finished yet."""


class Recording(NamedTuple):
    """What to open, and what its results are called."""

    source: str
    name: str


class Keeper(Protocol):
    """What is kept of a recording besides its table; it is sent to the workers."""

    @property
    def whole(self) -> bool:
        """Whether it needs all frames of a recording in order."""

    def keeping(
        self, stem: Path, source: DepthSource, frames: int, settings: Settings
    ) -> AbstractContextManager[Callable[[FrameResult], None]]:
        """Begin with a recording or a range; files are named after `stem`."""


@dataclass(frozen=True)
class Job:
    """What is done with every recording.

    Parameters
    ----------
    out : Path
        Where results go, the same place for every worker.
    settings : Settings
        Options of the run.
    keeper : Keeper
        What is kept besides the tables.
    force : bool
        Whether to repeat what is done already.
    version : str
        The client's.
    """

    out: Path
    settings: Settings
    keeper: Keeper
    force: bool = False
    version: str = __version__

    @property
    def stated(self) -> dict[str, Any]:
        """The settings that results depend on."""
        stated = asdict(self.settings)
        del stated["viewer"], stated["play"], stated["run"]["threads"], stated["run"]["no_governor"]
        file = self.settings.acquire.by.rpartition(":")[0]
        own = hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
        return stated | {"keep": repr(self.keeper), "by_file": own}

    @property
    def in_one_piece(self) -> bool:
        """Whether something is carried from frame to frame."""
        return self.settings.gas.training == "live" or self.settings.acquire.memory != "off" or self.keeper.whole

    def table(self, recording: Recording) -> Path:
        """Where a recording's table goes."""
        return self.out / f"{recording.name}.parquet"

    def part(self, recording: Recording, start: int) -> Path:
        """Where the table of a range is until all of them are done."""
        return self.out / WORK / recording.name / f"{start:09}.parquet"


@dataclass(frozen=True)
class Cut:
    """A recording to be done in ranges.

    Parameters
    ----------
    starts : tuple of int
        The first frame of each.
    stop : int
        The frame after the last.
    key, about
        What its table will say of itself.
    """

    starts: tuple[int, ...]
    stop: int
    key: str
    about: dict[str, Any]

    def span(self, at: int) -> range:
        """The frames of a range."""
        return range(self.starts[at], (*self.starts, self.stop)[at + 1])


def do_recording(job: Job, recording: Recording) -> dict[str, Any] | Cut:
    """Do a recording, unless it is done; returns its row of the summary, or how it is to be cut."""
    began_s = time.perf_counter()
    if job.version != __version__:
        raise AppError(f"a worker has version {__version__}, the client {job.version}; install the same everywhere.")
    key, size_bytes = _key(job, recording)
    path = job.table(recording)
    if not job.force and (found := found_done(path, key)) is not None:
        return found | {"recording": recording.name, "source": recording.source, "done_before": True}
    about = {"recording": recording.name, "source": recording.source, "bytes": size_bytes, "state": "failed"}
    try:
        with open_source(recording.source) as source:
            limit, count = job.settings.run.frames, source.frame_count
            if count is None and limit is None:
                raise SourceError(
                    f"'{recording.source}' never ends; say how many frames are wanted, as in --frames 100."
                )
            stop = min(each for each in (limit, count) if each is not None)
            camera = source.camera
            about |= {"width": camera.width, "height": camera.height, "fps": source.fps}
            if not job.in_one_piece and stop >= 2 * RANGE_FRAMES:
                step = max(RANGE_FRAMES, -(-stop // MOST_RANGES))
                return Cut(tuple(range(0, stop - step // 2, step)), stop, key, about)
            with writing(path, job.stated) as table:
                about |= _do_frames(job, recording, source, range(stop), table)
                return table.finish(key, about | {"work_s": time.perf_counter() - began_s})
    except (AppError, OutputError):  # of no recording's making
        raise
    except Exception as error:  # noqa: BLE001 - one recording must not end a thousand others
        path.unlink(missing_ok=True)
        return about | {"frames": 0, "failure": sentence_of(error), "work_s": time.perf_counter() - began_s}


def do_range(job: Job, recording: Recording, cut: Cut, at: int) -> dict[str, Any]:
    """Do a range of a recording's frames, unless it is done; returns its row of the summary."""
    began_s = time.perf_counter()
    span, path = cut.span(at), job.part(recording, cut.starts[at])
    if not job.force and (found := found_done(path, cut.key)) is not None:
        return found
    with open_source(recording.source) as source, writing(path, job.stated) as table:
        source.skip(span.start)
        about = _do_frames(job, recording, source, span, table, last=span.stop == cut.stop)
        return table.finish(cut.key, about | {"work_s": time.perf_counter() - began_s})


def join(job: Job, recording: Recording, cut: Cut, ranges: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the tables of the ranges into one, up to the first damage; returns its row of the summary."""
    path = job.table(recording)
    about, key = cut.about, cut.key
    with writing(path, job.stated) as table:
        for start, each in zip(cut.starts, ranges, strict=True):
            about |= {name: each[name] for name in ("state", "failure", "colour") if each.get(name) is not None}
            for row in rows_of(job.part(recording, start)) if each["frames"] else ():
                table.add(row)
            if each["failure"]:
                about["state"] = "damaged" if table.rows else "failed"
                key = "" if each.get("unfinished") else key  # to be tried again
                break
        row = table.finish(key, about | {"work_s": sum(each["work_s"] for each in ranges)})
    if key:
        shutil.rmtree(job.part(recording, 0).parent, ignore_errors=True)
    return row


_warm = False


def _do_frames(
    job: Job, recording: Recording, source: DepthSource, span: range, table: FigureTable, *, last: bool = True
) -> dict[str, Any]:
    """Pass every frame through the pipeline to the table and to what is kept; returns state, failure and colour."""
    global _warm
    said_s = time.monotonic()
    colour = False
    stem = job.out / recording.name
    with (
        Pipeline(job.settings, one_thread=True) as pipeline,
        job.keeper.keeping(stem, source, len(span), job.settings) as keep,
    ):
        feed = Feed(source, len(span))
        for read in feed:
            frame = read.frame
            assert frame is not None  # a recording is never silent
            if not table.rows:
                if not _warm:
                    with Pipeline(job.settings, one_thread=True) as first:
                        first.warm_up(frame)
                    _warm = True
                pipeline.train(frame)
            colour |= frame.colour is not None
            pipeline.begin(frame, read_ms=read.read_ms)
            for result in pipeline.rest():
                table.add(row_of(result))
                keep(result)
            if time.monotonic() - said_s > TELL_S:
                said_s = time.monotonic()
                tell((f"{recording.name} {span.start}", table.rows))
    empty = "" if table.rows else f"'{recording.source}' holds no frame."
    failure = str(feed.damage or (source.damage if last else "") or empty) or None
    state = "whole" if failure is None else "damaged" if table.rows else "failed"
    return {"state": state, "failure": failure, "colour": colour}


def _key(job: Job, recording: Recording) -> tuple[str, int]:
    """A key that changes with the settings, the version and the recording; and the recording's size in bytes."""
    name, options = parted(recording.source)
    files = sorted(_files(Path(name)))
    told = (SCHEMA, __version__, job.stated, options, files)
    text = json.dumps(told if files else (*told, recording.source))
    return hashlib.sha256(text.encode()).hexdigest(), sum(size for _, size, _ in files)


def _files(path: Path) -> Iterator[tuple[str, int, int]]:
    """Name, size and time of a file, or of all those in a folder."""
    paths = [path] if path.is_file() else (Path(folder, n) for folder, _, names in os.walk(path) for n in names)
    for each in paths:
        about = each.stat()
        yield os.path.relpath(each, path), about.st_size, about.st_mtime_ns
