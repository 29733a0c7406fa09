"""Every sink where a run is seen, each fed by a thread of its own."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from collections import deque
from pathlib import Path

from selective_depth.app.console.errors import ViewerError
from selective_depth.app.pipeline import StageTimes
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.handover import Handover
from selective_depth.app.viewer.sinks import FileSink, Item, RemoteSink, ServedSink, Showing, Sink, WindowSink
from selective_depth.app.viewer.stream import APPLICATION, never_wait_at_exit
from selective_depth.app.viewer.window import BIRTH_S, has_display
from selective_depth.drivers.errors import OutputError

READY_S = 5.0
"""How long a sink may take to open before the run begins without it."""
STALL_S = 0.5
"""A viewer that takes longer over a result has stalled; a recording no longer waits for it."""
CLOSE_ALL_S = 2.5
"""How long all sinks together may take over their last frames."""
FILE_QUEUE = 8
"""Results of a sensor's frames that may wait for a file, while what was written is made sure of."""
INDEXED_FRAMES = 1000
"""A file of up to this many frames gets an index; beyond, that would take too much memory."""


class Viewer:
    """Every sink where a run is seen, each fed by a thread of its own.

    Parameters
    ----------
    options : ViewerOptions
        Which sinks.
    live : bool
        A live source waits for nobody: what a sink has no time for is dropped there. A
        recording waits for its file always, and for a viewer that is not stalled.
    times : StageTimes
        Where the time that logging takes is added, as stage ``log``.
    frames : int, optional
        How many frames will come at most; a file of few gets an index.
    title : str, default ""
        What is run and how. Runs of the same title share their layout where a viewer has several.
    fallback : Path, optional
        File to save to where nothing was asked for and no window opens; by default none.

    Attributes
    ----------
    options : ViewerOptions
        Which sinks it came to: with the fallback as `save`, if it was needed.

    Raises
    ------
    OutputError, ViewerError
        If a sink cannot be written, reached or served. A window that does not start is none
        of these: it is told by `news`.
    """

    def __init__(
        self,
        options: ViewerOptions,
        *,
        live: bool,
        times: StageTimes,
        frames: int | None = None,
        title: str = "",
        fallback: Path | None = None,
    ) -> None:
        self.options = options
        self._news: deque[str] = deque()
        self._index = frames is not None and frames <= INDEXED_FRAMES
        showing = Showing(options, times, self._news.append, _application(title, options))
        self._sinks: list[Sink] = []
        try:
            self._open_all(showing, fallback)
        except Exception:
            for sink in self._sinks:
                if isinstance(sink, FileSink):
                    sink.discard()
            raise
        self._ways = [_handover(sink, live) for sink in self._sinks]
        for way in self._ways:
            if isinstance(way.sink, ServedSink):  # whoever is told of it may join at once
                way.ready.wait(READY_S)
                if way.failure is not None:
                    self.close()
                    raise way.failure

    def _open_all(self, showing: Showing, fallback: Path | None) -> None:
        options = self.options
        if options.save is not None:
            self._sinks.append(FileSink(options.save, showing, index=self._index))
        if options.serve:
            self._sinks.append(ServedSink(showing))
        if options.connect is not None:
            self._sinks.append(RemoteSink(options.connect, showing))
        if options.headless or options.connect is not None:
            return
        display = has_display()
        why = self._open_window(showing) if display else "No display here."
        if why and fallback is not None and not (options.save or options.serve):
            self._save_instead(fallback, showing)
            self._news.append(f"{why} Saving to {fallback}; open it with 'rerun {fallback}'.")
        elif why and display:
            self._news.append(why)

    def _open_window(self, showing: Showing) -> str:
        """Open the window; returns a sentence on why the run cannot rely on it, or nothing."""
        try:
            served = [other.port for other in self._sinks if isinstance(other, ServedSink)]
            sink = WindowSink(showing, served)
        except ViewerError as error:
            return f"{str(error)[0].upper()}{str(error)[1:]}"
        self._sinks.append(sink)
        return "" if sink.window.awake else f"The viewer window has not opened within {BIRTH_S:g} s."

    def _save_instead(self, path: Path, showing: Showing) -> None:
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"'{path}' cannot be written: {error.strerror}. Name another file with --save, or none with --headless."
            ) from None
        self._sinks.insert(0, FileSink(path, showing, index=self._index))
        self.options = dataclasses.replace(self.options, save=path)

    def news(self) -> list[str]:
        """What has happened to the sinks since the last call, a sentence each."""
        return [self._news.popleft() for _ in range(len(self._news))]

    @property
    def served_url(self) -> str:
        """Address at which viewers join; empty if nothing is served, or no more."""
        return next((way.sink.url for way in self._ways if isinstance(way.sink, ServedSink) and not way.failure), "")

    def wait_ready(self) -> None:
        """Wait until every sink is open, though for none that stalls."""
        for way in self._ways:
            way.ready.wait(READY_S)

    def wait_taken(self) -> None:
        """Wait until every sink has taken all that it was handed, though for none that stalls."""
        deadline_s = time.monotonic() + STALL_S
        for way in self._ways:
            way.wait_empty(max(0.0, deadline_s - time.monotonic()))

    def show(self, item: Item) -> None:
        """Hand a frame's result, or the sensor's state without one, to every sink.

        Raises
        ------
        Exception
            What ended the file that was asked for; a viewer that is gone is no error.
        """
        for way in self._ways:
            way.offer(item)
            if isinstance(way.sink, FileSink) and way.failure is not None:
                raise way.failure

    @property
    def file_failed(self) -> bool:
        """Whether a file that was asked for ended before its time."""
        return any(isinstance(way.sink, FileSink) and way.failure for way in self._ways)

    @property
    def dropped(self) -> dict[str, int]:
        """Results that each sink has missed, by its name."""
        return {way.sink.name: way.sink.missed + way.dropped for way in self._ways}

    def close(self) -> list[str]:
        """Finish every sink, all of them within 3 s.

        Returns
        -------
        list of str
            What went wrong, a sentence each.
        """
        never_wait_at_exit()
        deadline_s = time.monotonic() + CLOSE_ALL_S
        troubles = []
        for way in self._ways:
            if not way.finish(max(0.1, deadline_s - time.monotonic())):
                troubles.append(f"the {way.sink.name} had stalled and was left behind.")
            elif way.failure is not None:
                troubles.append(f"the {way.sink.name} ended early: {way.failure}")
        return troubles


def _handover(sink: Sink, live: bool) -> Handover:
    file = isinstance(sink, FileSink)
    if live:
        return Handover(sink, capacity=FILE_QUEUE if file else 2)
    return Handover(sink, patience_s=math.inf if file else STALL_S)


def _application(title: str, options: ViewerOptions) -> str:
    """Application id of a run: letters, digits, dashes; the same for the same layout only."""
    limits = f"{options.near_mm}-{options.far_mm}" if options.near_mm or options.far_mm else ""
    words = (APPLICATION, title, options.layout, "detail" * options.detail, limits)
    return " ".join(re.sub(r"[^A-Za-z0-9_-]+", " ", " ".join(words)).split())
