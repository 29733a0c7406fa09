"""Many recordings in one command: what is kept of each, progress, and what it came to."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from selective_depth.app.archive import SUMMARY_FILE, Batch, Job, Stream, dashboard, engine
from selective_depth.app.commands.model import save_depth, save_result
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import FAILED, OK
from selective_depth.app.console.output import make_folder, write_image
from selective_depth.app.console.progress import FrameProgress
from selective_depth.app.pictures import contact_sheet, write_picture
from selective_depth.app.pipeline import FrameResult, StageTimes, figures_of, say, selector_of
from selective_depth.app.settings import BatchOptions, Settings, ViewerOptions
from selective_depth.drivers.source import DepthSource

MOST_ROWS = 40
"""Recordings that are listed on the terminal; the summary has them all."""
SHOWN = ("frames", "samples", "rmse_mm", "even_rmse_mm", "loop_ms")


@dataclasses.dataclass(frozen=True)
class Keeping:
    """What is kept of each recording, in the folder ``NAME.kept`` beside its table.

    Parameters
    ----------
    kinds : tuple of str
        Of every frame: masks, maps, depth.
    models, rrd : bool
        The last frame's model; a Rerun recording.
    stills : int
        How many pictures of single frames.
    """

    kinds: tuple[str, ...] = ()
    models: bool = False
    rrd: bool = False
    stills: int = 0

    @property
    def whole(self) -> bool:
        """Whether it needs all frames of a recording, in their order."""
        return self.models or self.rrd

    @contextmanager
    def keeping(
        self, stem: Path, source: DepthSource, frames: int, settings: Settings
    ) -> Iterator[Callable[[FrameResult], None]]:
        """Begin with a recording or a range; what is called with each result is returned."""
        folder = stem.with_name(f"{stem.name}.kept")
        for name in (*self.kinds, *(["stills"] if self.stills else [])):
            make_folder(folder / name)
        count = source.frame_count or frames
        wanted = {at * count // self.stills for at in range(self.stills)}
        recording = folder / "recording.rrd"
        part = recording.with_name(".recording.part.rrd")
        viewer = None
        if self.rrd:
            from selective_depth.app.viewer import Viewer

            make_folder(folder)
            part.unlink(missing_ok=True)
            seen = ViewerOptions(headless=True, save=part)
            viewer = Viewer(seen, live=False, times=StageTimes(), frames=frames, title="batch")
        last: FrameResult | None = None

        def keep(result: FrameResult) -> None:
            nonlocal last
            last = result
            name = f"{result.frame.index:06}.png"
            for kind in self.kinds:
                _save(folder / kind / name, kind, result)
            if result.frame.index in wanted:
                title = f"{stem.name}, frame {result.frame.index}"
                write_picture(folder / "stills" / name, contact_sheet((title, result)))
            if viewer is not None:
                result.figures.update(figures_of(result))
                viewer.show(result)

        try:
            yield keep
        finally:
            if viewer is not None:
                viewer.close()
        if viewer is not None:
            part.replace(recording)
        if last is not None and self.models:
            save_result(folder / "model", last)


def _save(path: Path, kind: str, result: FrameResult) -> None:
    if kind == "depth":
        if result.model is not None:
            save_depth(path, result.model.depth_mm)
    elif kind == "masks":
        write_image(path, result.regions.mask.astype(np.uint8) + 2 * result.improvement.mask.astype(np.uint8))
    else:
        score = np.nan_to_num(result.improvement.score)
        write_image(path, np.rint(65535 * np.clip(score, 0, 1)).astype(np.uint16))


def run_batch(sources: Sequence[str], out: Path, options: BatchOptions, settings: Settings) -> int:
    """Do every recording, say how far it is, and print what it came to.

    Returns
    -------
    int
        Exit code: 0, or 1 if a recording is not whole.
    """
    if not sources:
        raise UsageError("no source was named; give recordings, folders that hold some, or - for a list on stdin.")
    if any(Path(source).is_dir() and Path(source).resolve() == out.resolve() for source in sources):
        raise UsageError(f"--out is '{out}', which holds the recordings; name another folder.")
    if not settings.acquire.budget and (options.models or "depth" in options.keep):
        raise UsageError("--models and --keep depth are of what a --budget acquires; give one, such as 5%.")
    selector_of(settings, 1)  # refuses what there is not
    make_folder(out)
    file, colon, name = settings.acquire.by.rpartition(":")
    by = f"{Path(file).absolute()}:{name}" if colon else name
    settings = dataclasses.replace(
        settings,
        acquire=dataclasses.replace(settings.acquire, by=by),
        run=dataclasses.replace(settings.run, frames=options.frames, threads=1),
    )
    keeper = Keeping(options.keep, options.models, options.rrd, options.stills)
    job = Job(out.absolute(), settings, keeper, options.force)
    with FrameProgress("Batch", None) as progress:
        batch = Batch(job, sources, lambda row: progress.say(f"{row['recording']}: {row['failure']}"))
        with engine(options.scheduler, options.workers) as client:
            began_s = time.monotonic()
            if address := dashboard(client):
                progress.say(f"dashboard: {address}")
            summary = batch.run(client, lambda stream: progress.update(*_note(batch, stream, began_s)))
    _print(summary, batch, time.monotonic() - began_s, out)
    return FAILED if batch.failures else OK


def _note(batch: Batch, stream: Stream, began_s: float) -> tuple[int, str]:
    """How far it is: frames done, and the rest in words."""
    seconds = time.monotonic() - began_s
    found = f"{batch.listed:,}{'' if batch.complete else ' or more'}"
    note = f"· {batch.done:,} of {found} recordings · {batch.frames / max(seconds, 1e-9):.1f} frames/s"
    fresh = batch.done - batch.skipped
    if not stream.workers:
        note += " · no worker yet"
    elif batch.complete and fresh:
        left_s = seconds / fresh * (batch.listed - batch.done)
        note += f" · about {left_s / 60:.0f} min left" if left_s > 90 else f" · about {left_s:.0f} s left"
    return batch.frames, note


def _print(summary: pa.Table, batch: Batch, seconds: float, out: Path) -> None:
    """The summary on the terminal: recordings as far as there is room for them, all failures, the whole."""
    rows = []
    for row in summary.slice(0, MOST_ROWS).to_pylist():
        figures = ["" if row[name] is None else f"{row[name]:,.{0 if name in SHOWN[:2] else 1}f}" for name in SHOWN]
        rows.append((row["recording"], *figures, "" if row["state"] == "whole" else row["state"]))
    print_table(rows, ("recording", *SHOWN, ""), justify="l" + "r" * len(SHOWN) + "l")
    if len(summary) > MOST_ROWS:
        say(f"and {len(summary) - MOST_ROWS:,} more")
    say("")
    for row in summary.filter(pc.is_valid(summary["failure"])).to_pylist():
        say(f"{row['recording']}: {row['failure']}")
    before = f", {batch.skipped:,} of them done before" if batch.skipped else ""
    done = f"{batch.done:,} recording{'s' * (batch.done != 1)} ({batch.failures:,} not whole{before})"
    there = pc.sum(summary["frames"]).as_py() or 0
    pace = f"{batch.frames:,} frames in {seconds:.1f} s, {batch.frames / max(seconds, 1e-9):.1f} frames/s"
    say(f"{done}, {there:,} frames; {pace}")
    say(f"wrote {out / SUMMARY_FILE}")
