"""What people change while a run goes on, from whatever thread: asked for here, done between two frames."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.output import make_folder
from selective_depth.app.pipeline import SELECTOR_NAMES
from selective_depth.app.settings import LAYERS, LAYOUTS, MOST_ROUNDS, AcquireOptions, Settings, ViewerOptions
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni import OniRecorder
from selective_depth.drivers.source import DepthSource

BUDGETS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""What the keys go through, as shares of the pixels."""
MEMORY_BUDGET = 0.02
"""What a memory spends a frame where nothing was spent before."""
FOLDER = Path("out")
"""Where recordings and pictures go that are asked for without a name."""
NEWS = 5
"""How many of the last sentences are kept for people who look on."""

_ALLOWED: dict[str, Callable[[Any], object]] = {
    "budget": lambda x: 0 <= x <= 1,
    "rounds": lambda x: 1 <= x <= MOST_ROUNDS and int(x) == x,
    "by": lambda x: x in SELECTOR_NAMES,
    "memory": lambda x: x in ("off", "still"),
    "layout": lambda x: x in LAYOUTS,
    "hide": lambda x: set(x) <= set(LAYERS),
    "paused": lambda x: isinstance(x, bool),
    "recording": lambda x: isinstance(x, bool),
} | dict.fromkeys(("snapshot", "reset", "stop"), lambda x: x is None)
"""What may be asked for, and which values: no names of files, no code."""


@dataclass(frozen=True)
class Status:
    """How a run stands, for people who look on.

    Attributes
    ----------
    acquire, viewer
        The options that hold now.
    paused, recording, ended : bool
        Whether it waits, records, has ended.
    frames, fps, skipped
        So far, now, so far.
    state : str
        The source's, with the reason.
    gain, given_up : str
        As of `FrameResult`.
    news : tuple of str
        The last sentences.
    """

    acquire: AcquireOptions
    viewer: ViewerOptions
    paused: bool = False
    recording: bool = False
    ended: bool = False
    frames: int = 0
    fps: float = 0.0
    skipped: int = 0
    state: str = "starting"
    gain: str = ""
    given_up: str = ""
    news: tuple[str, ...] = ()


class Steering:
    """Takes what is asked of a run, and holds what is known of it.

    Attributes
    ----------
    paused : bool
        Whether frames go by unprocessed.
    stopped : bool
        Whether the run is to end.
    status : Status or None
        How it stands; None before it has begun.
    news : deque of str
        The last sentences, for people who look on.
    """

    def __init__(self) -> None:
        self.paused = self.stopped = False
        self.status: Status | None = None
        self._asked: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self.news: deque[str] = deque(maxlen=NEWS)

    def ask(self, name: str, value: Any = None) -> None:
        """Ask for a change: see `Status` and ``_ALLOWED``.

        Raises
        ------
        UsageError
            If there is no such thing to change, or it cannot have that value.
        """
        try:
            good = _ALLOWED[name](value)
        except (KeyError, TypeError, ValueError):
            good = False
        if not good:
            raise UsageError(f"a run cannot be asked for {name!r:.40} {value!r:.40}.")
        self._asked.put((name, value))

    def press(self, key: str) -> None:
        """Ask for what a key of the terminal stands for; see `console.keys.KEYS`."""
        self._asked.put(("key", key))

    def meant(self, key: str) -> tuple[str, Any] | None:
        """What a key stands for as things are now, when it is its turn; None for any other key."""
        status = self.status
        if status is None:
            return None
        spend = status.acquire
        wishes: dict[str, tuple[str, Any]] = {
            " ": ("paused", not self.paused),
            "+": ("budget", next((x for x in BUDGETS if x > spend.budget + 1e-9), BUDGETS[-1])),
            "-": ("budget", next((x for x in BUDGETS[::-1] if x < spend.budget - 1e-9), 0.0)),
            "]": ("rounds", min(spend.rounds + 1, 16)),
            "[": ("rounds", max(spend.rounds - 1, 1)),
            "s": ("by", dict(pairwise(SELECTOR_NAMES)).get(spend.by, SELECTOR_NAMES[0])),
            "m": ("memory", "off" if spend.memory == "still" else "still"),
            "r": ("recording", not status.recording),
            "p": ("snapshot", None),
            "l": ("layout", LAYOUTS[(LAYOUTS.index(status.viewer.layout) + 1) % 2]),
            "x": ("reset", None),
            "q": ("stop", None),
        }
        return wishes.get(key)

    def take(self) -> list[tuple[str, Any]]:
        """What was asked for since the last call."""
        return [self._asked.get() for _ in range(self._asked.qsize())]


def changed(settings: Settings, name: str, value: Any) -> Settings:
    """Settings with one of the options that may be changed on the way."""
    if name in ("layout", "hide"):
        return replace(settings, viewer=replace(settings.viewer, **{name: value}))
    spend = replace(settings.acquire, **{name: value})
    if spend.memory == "still" and not spend.budget:  # a memory has to have something to spend, and something has
        spend = replace(spend, memory="off") if name == "budget" else replace(spend, budget=MEMORY_BUDGET)
    return replace(settings, acquire=spend)


def unused(stem: str, ending: str) -> Path:
    """A new name in `FOLDER`, which is made if need be; it holds the time.

    Raises
    ------
    OutputError
        If it cannot be made.
    """
    make_folder(FOLDER)
    return FOLDER / f"{stem}-{datetime.now():%Y%m%d-%H%M%S-%f}{ending}"  # to the microsecond, so that none is taken


class Recording(OniRecorder):
    """Frames of a source on their way into an .oni file, for as long as this lives.

    Parameters
    ----------
    source : DepthSource
        What is recorded: every frame that it makes.
    path : Path
        The file.
    overwrite : bool
        Whether a file of that name is replaced.

    Attributes
    ----------
    seconds : float
        For how long was recorded; 0 until it has stopped.

    Raises
    ------
    OutputError
        If nothing can be written to that place, or there is something already.
    """

    def __init__(self, source: DepthSource, path: Path, overwrite: bool = False) -> None:
        super().__init__(path, fps=source.fps, overwrite=overwrite)
        self.seconds = 0.0
        self._source = source
        self._began_s = time.monotonic()
        self._began_us: int | None = None
        source.tap = self.write

    def write(self, frame: DepthFrame) -> None:
        """Hand a frame over; it is on the disk a little later."""
        if self._began_us is None:
            self._began_us = frame.timestamp_us
        super().write(frame)

    def has(self, frame: DepthFrame) -> bool:
        """Whether a frame of the source is in it: those before it began are not."""
        return self._began_us is not None and frame.timestamp_us >= self._began_us

    def stop_beside(self, tell: Callable[[str], None]) -> threading.Thread:
        """Take no more frames, and finish the file in a thread of its own; `tell` gets a sentence when that is done."""
        self._source.tap = None
        self.seconds = time.monotonic() - self._began_s

        def finish() -> None:
            tell(self.close() or f"Recorded {self.frames:,} frames to {self.path}.")

        thread = threading.Thread(target=finish, name="finishing a recording")
        thread.start()
        return thread
