"""A run from its source to its report: where source, pipeline and viewer meet."""

from __future__ import annotations

import gc
import logging
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from selective_depth.app.archive import FigureTable, row_of, writing
from selective_depth.app.commands.model import save_result
from selective_depth.app.commands.steering import Recording, Status, Steering, changed, unused
from selective_depth.app.console import interrupt
from selective_depth.app.console.exit_codes import FAILED, INTERRUPTED, OK
from selective_depth.app.console.progress import FrameProgress, waiting
from selective_depth.app.pictures import contact_sheet, write_picture
from selective_depth.app.pipeline import (
    Feed,
    FrameResult,
    Governor,
    Pipeline,
    RunReport,
    SensorNote,
    figures_of,
    gain_of,
    mean_of,
    open_and_tell,
    save_settings,
    say,
    state_of,
)
from selective_depth.app.settings import Settings
from selective_depth.app.viewer import Viewer, join_command
from selective_depth.drivers.errors import DeviceLostError, OutputError, SourceTimeoutError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.drivers.played import PlayedSource
from selective_depth.drivers.realtime import RealtimeSource
from selective_depth.drivers.source import DepthSource
from selective_depth.selectors.parallel import default_threads

log = logging.getLogger(__name__)
WAIT_S = 0.1
"""How long nothing is looked at while a run is paused."""
TURN_S = 1e-4
"""How long a thread may keep the interpreter from another that waits for it. Kernels run without it and need it
for a moment between two: with Python's own 5 ms a sensor's frames were skipped meanwhile (docs: limits.md)."""


def beside(saved: Path) -> tuple[Path, Path]:
    """Where the settings and the picture of a saved run go."""
    return saved.with_suffix(".toml"), saved.with_suffix(".png")


class Session:
    """One run.

    Parameters
    ----------
    uri : str
        As for `open_source`.
    settings : Settings
        All options, checked.
    steering : Steering, optional
        What is asked of it on the way.

    Attributes
    ----------
    settings : Settings
        Those that hold now.
    report : RunReport
        What it has come to.
    last : FrameResult or None
        The last result.
    prepare : callable
        Called with pipeline and first frame before the second is read: `Pipeline.warm_up`, and whatever else
        is to be ready then.
    """

    def __init__(self, uri: str, settings: Settings, steering: Steering | None = None) -> None:
        self.settings = settings
        self.steering = steering or Steering()
        self.report = RunReport(uri, live=False)
        self.prepare: Callable[[Pipeline, DepthFrame], FrameResult] = Pipeline.warm_up
        self._uri = uri
        self.last: FrameResult | None = None
        self._code = OK
        self._ready_s = self._ready_cpu_s = 0.0
        self._recent_s: deque[float] = deque(maxlen=31)
        self._recent: deque[dict[str, float]] = deque(maxlen=30)
        self._governor: Governor
        self._table: FigureTable | None = None
        self._recording: Recording | None = None
        self._recorded: list[Recording] = []
        self._unfinished: list[threading.Thread] = []
        self._source: DepthSource
        self._pipeline: Pipeline
        self._viewer: Viewer
        self._progress: FrameProgress
        self._went_by = 0  # frames that a sensor made while the run was paused

    def run(self, hint: str = "") -> int:
        """Run to the end of the source, the asked number of frames, or Ctrl-C.

        Parameters
        ----------
        hint : str, optional
            What is shown beside the progress: the keys that there are.

        Returns
        -------
        int
            Exit code, as for `watch`.
        """
        report, seen = self.report, self.settings.viewer
        with ExitStack() as stack:
            stack.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(TURN_S)
            with waiting(f"Opening {self._uri}"):
                source = stack.enter_context(self._open())
            sensor = source.live
            if (speed := self.settings.play.speed or float(self.settings.play.realtime)) and not sensor:
                source = stack.enter_context(RealtimeSource(source, speed))
            report.live = source.live
            _tell(source)
            self._source = source
            self._pipeline = stack.enter_context(Pipeline(self.settings, realtime=source.live))
            governed = source.live and not self.settings.run.no_governor
            self._governor = Governor(self.settings.acquire, 1000 / source.fps if governed else None)
            limits = self.settings.run.frames, source.frame_count
            frames = min((limit for limit in limits if limit is not None), default=None)  # None: unknown
            if seen.table is not None:
                self._table = stack.enter_context(writing(seen.table, {"source": self._uri}))
            viewer = self._viewer = self._open_viewer(frames)
            try:
                with interrupt.recognised(), FrameProgress(self._uri, frames, hint) as self._progress:
                    self._flow()
                if viewer.served_url and not sensor and not self.steering.stopped:
                    say("All frames are served; Ctrl-C ends.")
                    threading.Event().wait()
            except KeyboardInterrupt:
                self._code = INTERRUPTED
            finally:
                report.troubles += [*viewer.close(), *viewer.news()]
                if viewer.file_failed and self._code == OK:
                    self._code = FAILED
                self._finish_recordings()
                report.troubles = [*source.notes, *report.troubles]
                report.missed = viewer.dropped
                report.state = state_of(source)
                report.dropped = source.dropped - report.dropped_starting - self._went_by
                report.stages = self._pipeline.times.summary()
                report.given_up, report.given_up_frames = self._governor.most.said, self._governor.frames
                self._publish(ended=True)
            if self._table is not None:
                self._table.finish("", {"source": self._uri})
                report.written += [seen.table] if seen.table and self._table.rows else []
            if viewer.options.save is not None and self.last is not None:
                self._write_beside(viewer.options.save, self.last)
            if seen.save_model is not None and self.last is not None:
                report.written += save_result(seen.save_model, self.last)
        return self._code

    def _open(self) -> DepthSource:
        """The source, played as it was asked for."""
        source, play = open_and_tell(self._uri), self.settings.play
        if source.live or (play.start, play.every, play.loop) == (0, 1, False):
            return source
        again = partial(open_source, self._uri) if play.loop else None
        return PlayedSource(source, again, start=play.start, every=play.every)

    def _open_viewer(self, frames: int | None) -> Viewer:
        """Open every place where the run is to be seen, and tell what came of it."""
        spend = self.settings.acquire
        viewer = Viewer(
            self.settings.viewer,
            live=self.report.live,
            times=self._pipeline.times,
            frames=frames,
            title=f"{Path(self._uri).name} {f'by {spend.by}' if spend.budget else ''}",
            fallback=Path("out", "live.rrd" if self._uri.startswith("openni") else "replay.rrd"),
        )
        self.settings = replace(self.settings, viewer=viewer.options)
        for sentence in viewer.news():
            say(sentence)
        if viewer.served_url:
            say(f"Serving; join with '{join_command(viewer.served_url)}'.")
        return viewer

    def _tell(self, sentence: str) -> None:
        """Say something at once, beside the progress and to people who look on."""
        self._progress.say(sentence)
        self.steering.news.append(sentence)

    def _hand_on(self, results: Iterable[FrameResult]) -> None:
        for result in results:
            self._show(result)
            self._progress.update(self.report.frames, f"{result.figures['fps']:.0f} frames/s")

    def _flow(self) -> None:
        """Source to pipeline to result to sinks, one frame after the other."""
        source, pipeline = self._source, self._pipeline
        feed = Feed(source, self.settings.run.frames)
        state, taken, skipped = state_of(source), 0, 0
        self._publish(state=state)
        for read in feed:
            for sentence in self._viewer.news():
                self._tell(sentence)
            if self._recording is not None and self._recording.failure:
                self._tell(f"Recording ended early: {self._recording.failure}.")
                self._record(False)
            if read.state != state:
                state = read.state
                with_reason = ": ".join(filter(None, (state, getattr(source, "state_reason", ""))))
                self._tell(f"sensor {with_reason}")
                self._publish(state=with_reason)
            if read.frame is None:
                self._viewer.show(SensorNote(state))
                self._hand_on(pipeline.rest())
                self._obey()
                continue
            if not self._ready_s:
                shown = self._get_ready(read.frame)
                taken += shown
                if shown:
                    continue
                if self.settings.viewer.record is not None:
                    self._record(True, read.frame)
            if not taken and self._recording is not None and not self._recording.has(read.frame):
                feed.frames = None if feed.frames is None else feed.frames + 1  # what is shown is recorded
                continue
            if taken == 1:
                self.report.dropped_starting = skipped = source.dropped
            taken += 1
            if taken > 1 and self._governor.note(source.dropped - skipped, read.read_ms):
                pipeline.ease(self._governor.eased)
                left_out = self._governor.eased.said
                self._tell(f"To keep up: {left_out}." if left_out else "Keeping up with all of it again.")
            skipped = source.dropped
            pipeline.begin(read.frame, state=state, read_ms=read.read_ms)
            self._hand_on(pipeline.finished())
            self._obey()
            if self.steering.paused:
                self._hand_on(pipeline.rest())
                skipped += self._wait()
            if self.steering.stopped:
                break
        if feed.damage is not None:
            self.report.troubles.append(str(feed.damage))
            self._code = FAILED
        self._hand_on(pipeline.rest())

    def _wait(self) -> int:
        """Wait until the run goes on; what a sensor makes meanwhile goes by, uncounted. Returns how much that was."""
        source, before = self._source, self._source.dropped
        while self.steering.paused and not self.steering.stopped:
            interrupt.check()
            if source.live:
                with suppress(SourceTimeoutError, DeviceLostError):
                    source.read(WAIT_S)
            else:
                time.sleep(WAIT_S)
            self._obey()
        went_by = source.dropped - before
        self._went_by += went_by
        return went_by

    def _obey(self) -> None:
        """Do what was asked for since the last frame."""
        for asked in self.steering.take():
            meant = self.steering.meant(asked[1]) if asked[0] == "key" else asked
            if meant is None:
                continue
            name, value = meant
            if name == "paused":
                self.steering.paused = value
            elif name == "stop":
                self.steering.stopped = True
            elif name == "reset":
                self._pipeline.forget()
            elif name in ("recording", "snapshot"):
                try:
                    self._record(value) if name == "recording" else self._take_picture()
                except OutputError as error:
                    self._tell(str(error))
            else:
                self._change(changed(self.settings, name, value))
            self._publish()  # for the next key, and for those who look on

    def _change(self, settings: Settings) -> None:
        if settings.acquire != self.settings.acquire:
            self._pipeline.adopt(settings)
            self.report.begin_anew()
            self._recent.clear()
            self._governor.restart(settings.acquire)
            self._pipeline.ease(self._governor.eased)
        self.settings = settings

    def _record(self, on: bool, first: DepthFrame | None = None) -> None:
        """Begin to record, under the name that was given for the first time, or stop.

        A recording's frame that was read already is `first`; a sensor's is too old by now.
        """
        if on and self._recording is None:
            seen = self.settings.viewer
            path = seen.record if seen.record and not self._recorded else unused("record", ".oni")
            self._recording = Recording(self._source, path, seen.overwrite)
            if first is not None and not self._source.live:
                self._recording.write(first)
            self._recorded.append(self._recording)
            self._tell(f"Recording to {path}.")
        elif not on:
            self._stop_recording(self._tell)

    def _stop_recording(self, tell: Callable[[str], None]) -> None:
        recording, self._recording = self._recording, None
        if recording is not None:
            self._unfinished.append(recording.stop_beside(tell))

    def _finish_recordings(self) -> None:
        """Finish what is recorded to the last frame, however long that takes."""
        self._stop_recording(self.report.troubles.append)
        for thread in self._unfinished:
            thread.join()
        self.report.recorded = {each.path: (each.frames, each.seconds) for each in self._recorded}
        self.report.written += [each.path for each in self._recorded if each.frames]

    def _take_picture(self) -> None:
        """A sheet of the last frame, drawn beside the run."""
        last = self.last
        if last is None:
            return
        path, title = unused("picture", ".png"), self._title(last)

        def draw() -> None:
            try:
                write_picture(path, contact_sheet((title, last)))
            except OutputError as error:
                self._tell(str(error))
            else:
                self._tell(f"Wrote {path}.")

        self._unfinished.append(threading.Thread(target=draw, name="drawing a picture"))
        self._unfinished[-1].start()

    def _get_ready(self, frame: DepthFrame) -> bool:
        """Compile, fill tables and caches with the first frame; whether that is shown already.

        A sensor's is: when all is ready it is too old to be made again, and whatever takes its time when
        something is logged for the first time is behind the run then.
        """
        source, pipeline, viewer, began_s = self._source, self._pipeline, self._viewer, time.monotonic()
        with waiting("Compiling for this machine; the next run starts at once"):
            first = self.prepare(pipeline, frame)
            viewer.wait_ready()
        gc.collect()
        gc.freeze()  # else what was imported and compiled is looked through again and again, a tenth of a second each
        shown = source.live and self.settings.viewer.record is None
        if shown:
            self._start_clock()
            self._show(replace(first, state=state_of(source)))
            viewer.wait_taken()
            pipeline.times.clear()
        self._start_clock()
        log.info("ready after %.1f s", self._ready_s - began_s)
        return shown

    def _start_clock(self) -> None:
        self._ready_s, self._ready_cpu_s = time.monotonic(), time.process_time()
        self._recent_s.clear()
        self._recent_s.append(self._ready_s)

    def _show(self, result: FrameResult) -> None:
        """Add what only the run knows of a result, and hand it to report and viewer."""
        now_s = time.monotonic()
        self._recent_s.append(now_s)
        figures = figures_of(result)
        self._recent.append(figures)
        result.figures.update(
            figures,
            fps=(len(self._recent_s) - 1) / (now_s - self._recent_s[0]),
            dropped_sensor=self._source.dropped - self._went_by,
            dropped_viewer=sum(self._viewer.dropped.values()),
        )
        result.stages_ms.update(self._pipeline.times.last_ms() | result.stages_ms)
        told = replace(
            result,
            gain=gain_of({name: mean_of(each[name] for each in self._recent) for name in figures}),
            given_up=self._governor.eased.said,
            look=self.settings.viewer,
        )
        self.report.take(told)
        self.report.seconds = now_s - self._ready_s
        self.report.processor_s = time.process_time() - self._ready_cpu_s
        self.last = told
        self._viewer.show(told)
        if self._table is not None:
            self._table.add(row_of(told))
        self._publish(
            state=told.state, gain=told.gain, given_up=told.given_up, fps=told.figures["fps"],
            skipped=self._source.dropped - self.report.dropped_starting - self._went_by,
        )  # fmt: skip

    def _publish(self, **known: Any) -> None:
        """Say how the run stands."""
        settings, now = self.settings, self.steering.status or Status(self.settings.acquire, self.settings.viewer)
        self.steering.status = replace(
            now,
            acquire=settings.acquire,
            viewer=settings.viewer,
            paused=self.steering.paused,
            recording=self._recording is not None,
            frames=self.report.frames,
            news=tuple(self.steering.news),
            **known,
        )

    def _title(self, last: FrameResult) -> str:
        return f"{self._uri.rstrip('/').rpartition('/')[2]}, frame {last.frame.index}"

    def _write_beside(self, saved: Path, last: FrameResult) -> None:
        """Settings and a picture of the last frame."""
        settings_file, picture_file = beside(saved)
        save_settings(settings_file, self.settings, self._uri)
        write_picture(picture_file, contact_sheet((self._title(last), last)))
        self.report.written += [saved, settings_file, picture_file]


def _tell(source: DepthSource) -> None:
    at, count = source.camera, "endless" if source.frame_count is None else source.frame_count
    log.info(
        f"{source.uri}: {count} frames, {at.width}x{at.height}, {source.fps:.4g} frames/s, fx {at.fx:.1f}"
        f" fy {at.fy:.1f} cx {at.cx:.1f} cy {at.cy:.1f}; {default_threads()} kernel threads"
    )
