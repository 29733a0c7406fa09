"""Signs of life on standard error while something takes its time."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from rich import progress
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

PATIENCE_S = 2.0
"""A wait longer than this is explained."""
REPEAT_S = 10.0
"""How often a log file, which cannot be redrawn, hears of it."""


@contextmanager
def waiting(why: str) -> Iterator[None]:
    """Say why, if what happens inside takes longer than `PATIENCE_S`."""
    timer = threading.Timer(PATIENCE_S, lambda: sys.stderr.write(f"{why} …\n"))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class FrameProgress:
    """How far a run has come: a bar on a terminal, now and then a line elsewhere.

    Parameters
    ----------
    what : str
        What is running.
    total : int or None
        Frames in all; None where that is not known.
    hint : str, optional
        Below the bar on a terminal: the keys that there are.
    """

    def __init__(self, what: str, total: int | None, hint: str = "") -> None:
        self._what, self._total = what, total
        self._start_s = self._said_s = time.monotonic()
        self._drawn = sys.stderr.isatty()
        self._bar = progress.Progress(
            progress.SpinnerColumn(),
            progress.TextColumn("{task.description}", markup=False),
            *((progress.BarColumn(),) if total else ()),
            progress.MofNCompleteColumn(),
            progress.TextColumn("frames"),
            progress.TimeElapsedColumn(),
            progress.TextColumn("{task.fields[note]}"),
        )
        self._task = self._bar.add_task(what, total=total, note="")
        below = [Text(hint, style="dim")] if hint else []
        self._live = Live(Group(self._bar, *below), console=Console(stderr=True), refresh_per_second=10, transient=True)

    def update(self, frames: int, note: str = "") -> None:
        """Show the number of frames done and a note, such as the sensor's state."""
        self._bar.update(self._task, completed=frames, note=note)
        now = time.monotonic()
        due_s = PATIENCE_S if self._said_s == self._start_s else REPEAT_S
        if not self._drawn and now - self._said_s > due_s:
            self._said_s = now
            total = f" of {self._total}" if self._total else ""
            sys.stderr.write(f"{self._what}: {frames}{total} frames {note}".rstrip() + "\n")

    def say(self, sentence: str) -> None:
        """Tell something at once, above the bar."""
        self._live.console.print(sentence, markup=False, highlight=False, soft_wrap=not self._drawn)

    def __enter__(self) -> Self:
        if self._drawn:
            self._live.start(refresh=True)
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._live.stop()
