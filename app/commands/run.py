"""A run from its source to its report: where source, pipeline and viewer meet."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from selective_depth.app.commands.model import save_result
from selective_depth.app.commands.snapshot import row_of
from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import FAILED, INTERRUPTED, OK
from selective_depth.app.console.progress import FrameProgress, waiting
from selective_depth.app.pictures import contact_sheet, write_picture
from selective_depth.app.pipeline import (
    Feed,
    FrameResult,
    Pipeline,
    RunReport,
    SensorNote,
    figures_of,
    is_settings,
    open_and_tell,
    print_report,
    save_settings,
    say,
    state_of,
)
from selective_depth.app.settings import Settings
from selective_depth.app.viewer import Viewer, join_command
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.realtime import RealtimeSource
from selective_depth.drivers.source import DepthSource
from selective_depth.selectors.parallel import default_threads

log = logging.getLogger(__name__)


def watch(uri: str, settings: Settings) -> int:
    """Run a source through both selectors into the viewer, and print what it came to.

    Parameters
    ----------
    uri : str
        As for `open_source`.
    settings : Settings
        All options.

    Returns
    -------
    int
        Exit code: 0, 1 if something that was asked for failed, 130 after Ctrl-C.
    """
    check(settings)
    session = Session(uri, settings)
    code = session.run()
    print_report(session.report)
    return code


def check(settings: Settings) -> None:
    """Refuse options that contradict each other; the range of each is in its type.

    Raises
    ------
    UsageError
        Naming the option, its value and what is allowed.
    """
    seen = settings.viewer
    near_mm, far_mm = seen.near_mm or 0, 65535 if seen.far_mm is None else seen.far_mm
    if far_mm <= near_mm:
        raise UsageError(f"--far-mm is {far_mm}; it must be more than --near-mm, {near_mm}.")
    if seen.save is not None:
        _check_save(seen.save)
    if seen.save_model is not None and not settings.acquire.budget:
        raise UsageError("--save-model writes what a --budget acquires; give one, such as 5%.")


def _beside(saved: Path) -> tuple[Path, Path]:
    """Where the settings and the picture of a saved run go."""
    return saved.with_suffix(".toml"), saved.with_suffix(".png")


def _check_save(path: Path) -> None:
    """Refuse a name that is none of a Rerun recording, or whose neighbours would be lost."""
    if path.suffix.lower() != ".rrd":
        raise UsageError(f"--save is '{path}'; it must end in .rrd, as Rerun recordings do.")
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UsageError(f"--save is {str(path)!r}; Rerun writes names in UTF-8 only.") from None
    settings, picture = _beside(path)
    ours = settings.is_file() and is_settings(settings)
    for beside in (settings, picture):
        if beside.exists() and not ours:
            raise UsageError(
                f"--save is '{path}', but '{beside}', which would be replaced by what is written"
                " beside it, is not of an earlier run. Give another name."
            )


class Session:
    """One run.

    Parameters
    ----------
    uri : str
        As for `open_source`.
    settings : Settings
        All options, checked.

    Attributes
    ----------
    report : RunReport
        What it has come to.
    last : FrameResult or None
        The last result.
    """

    def __init__(self, uri: str, settings: Settings) -> None:
        self.settings = settings
        self.report = RunReport(uri, live=False)
        self._uri = uri
        self.last: FrameResult | None = None
        self._code = OK
        self._ready_s = 0.0
        self._recent_s: deque[float] = deque(maxlen=31)

    def run(self) -> int:
        """Run to the end of the source, the asked number of frames, or Ctrl-C.

        Returns
        -------
        int
            Exit code, as for `watch`.
        """
        report = self.report
        with ExitStack() as stack:
            with waiting(f"Opening {self._uri}"):
                source = stack.enter_context(open_and_tell(self._uri))
            sensor = source.live
            if self.settings.run.realtime and not sensor:
                source = stack.enter_context(RealtimeSource(source))
            report.live = source.live
            _tell(source)
            report.troubles += source.notes
            told = len(source.notes)
            pipeline = stack.enter_context(Pipeline(self.settings, realtime=source.live))
            limits = self.settings.run.frames, source.frame_count
            frames = min((limit for limit in limits if limit is not None), default=None)  # None: nobody knows
            viewer = self._open_viewer(pipeline, frames)
            seen = viewer.options
            try:
                with interrupt.recognised(), FrameProgress(self._uri, frames) as progress:
                    self._flow(source, pipeline, viewer, progress)
                if viewer.served_url and not sensor:
                    say("All frames are served; Ctrl-C ends.")
                    threading.Event().wait()
            except KeyboardInterrupt:
                self._code = INTERRUPTED
            finally:
                report.troubles += [*viewer.close(), *viewer.news()]
                if viewer.file_failed and self._code == OK:
                    self._code = FAILED
                report.troubles += source.notes[told:]  # what came up on the way
                report.missed = viewer.dropped
                report.state = state_of(source)
                report.dropped = source.dropped - report.dropped_starting
                report.stages = pipeline.times.summary()
            if seen.save is not None and self.last is not None:
                self._write_beside(seen.save, self.last)
            if seen.save_model is not None and self.last is not None:
                report.written += save_result(seen.save_model, self.last)
        return self._code

    def _open_viewer(self, pipeline: Pipeline, frames: int | None) -> Viewer:
        """Open every place where the run is to be seen, and tell what came of it."""
        spend = self.settings.acquire
        viewer = Viewer(
            self.settings.viewer,
            live=self.report.live,
            times=pipeline.times,
            frames=frames,
            title=f"{Path(self._uri).name} {f'by {spend.by}' if spend.budget else ''}",
            fallback=Path("out", "live.rrd" if self._uri.startswith("openni") else "replay.rrd"),
        )
        self.settings = dataclasses.replace(self.settings, viewer=viewer.options)
        for sentence in viewer.news():
            say(sentence)
        if viewer.served_url:
            say(f"Serving; join with '{join_command(viewer.served_url)}'.")
        return viewer

    def _flow(self, source: DepthSource, pipeline: Pipeline, viewer: Viewer, progress: FrameProgress) -> None:
        """Source to pipeline to result to sinks, one frame after the other."""
        feed = Feed(source, self.settings.run.frames)
        state, taken = state_of(source), 0

        def hand_on(results: Iterable[FrameResult]) -> None:
            for result in results:
                self._show(result, source, pipeline, viewer)
                progress.update(self.report.frames, f"{result.figures['fps']:.0f} frames/s")

        for read in feed:
            for sentence in viewer.news():
                progress.say(sentence)
            if read.state != state:
                state = read.state
                reason = getattr(source, "state_reason", "")
                progress.say(f"sensor {state}{': ' if reason else ''}{reason}")
            if read.frame is None:
                viewer.show(SensorNote(state))
                hand_on(pipeline.rest())
                continue
            if taken == 0:
                self._get_ready(read.frame, pipeline, viewer)
            elif taken == 1:
                self.report.dropped_starting = source.dropped
            taken += 1
            pipeline.begin(read.frame, state=state, read_ms=read.read_ms)
            hand_on(pipeline.finished())
        if feed.damage is not None:
            self.report.troubles.append(str(feed.damage))
            self._code = FAILED
        hand_on(pipeline.rest())

    def _get_ready(self, frame: DepthFrame, pipeline: Pipeline, viewer: Viewer) -> None:
        began_s = time.monotonic()
        with waiting("Compiling for this machine; the next run starts at once"):
            pipeline.warm_up(frame)
            viewer.wait_ready()
        self._ready_s = time.monotonic()
        self._recent_s.append(self._ready_s)
        log.info("ready after %.1f s", self._ready_s - began_s)

    def _show(self, result: FrameResult, source: DepthSource, pipeline: Pipeline, viewer: Viewer) -> None:
        """Add what only the run knows of a result, and hand it to report and viewer."""
        now_s = time.monotonic()
        self._recent_s.append(now_s)
        result.figures.update(
            figures_of(result),
            fps=(len(self._recent_s) - 1) / (now_s - self._recent_s[0]),
            dropped_sensor=source.dropped,
            dropped_viewer=sum(viewer.dropped.values()),
        )
        result.stages_ms.update(pipeline.times.last_ms() | result.stages_ms)
        self.report.take(result)
        self.report.seconds = now_s - self._ready_s
        self.last = result
        viewer.show(result)

    def _write_beside(self, saved: Path, last: FrameResult) -> None:
        """Settings and a picture of the last frame."""
        settings_file, picture_file = _beside(saved)
        save_settings(settings_file, self.settings, self._uri)
        title = f"{self._uri.rstrip('/').rpartition('/')[2]}, frame {last.frame.index}"
        write_picture(picture_file, contact_sheet([row_of(last, title)]))
        self.report.written += [saved, settings_file, picture_file]


def _tell(source: DepthSource) -> None:
    at, count = source.camera, "endless" if source.frame_count is None else source.frame_count
    log.info(
        f"{source.uri}: {count} frames, {at.width}x{at.height}, {source.fps:.4g} frames/s, fx {at.fx:.1f}"
        f" fy {at.fy:.1f} cx {at.cx:.1f} cy {at.cy:.1f}; {default_threads()} kernel threads"
    )
