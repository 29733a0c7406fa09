"""Signs of life on standard error while something takes its time."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

PATIENCE_S = 2.0
"""A wait longer than this is explained."""
REPEAT_S = 10.0
"""How often a log file, which cannot be redrawn, hears of it."""


@contextmanager
def waiting(why: str) -> Iterator[None]:
    """Say why, if what happens inside takes longer than `PATIENCE_S`."""
    console = Console(stderr=True, highlight=False)
    timer = threading.Timer(PATIENCE_S, lambda: console.print(f"{why} …"))
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
        Frames in all; None where nobody knows.
    """

    def __init__(self, what: str, total: int | None) -> None:
        self._what = what
        self._total = total
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._start_s = self._said_s = time.monotonic()
        if sys.stderr.isatty():
            self._bar = Progress(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                *((BarColumn(),) if total else ()),
                MofNCompleteColumn(),
                TextColumn("frames"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[note]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._task = self._bar.add_task(what, total=total, note="")

    def update(self, frames: int, note: str = "") -> None:
        """Show the number of frames done and a note, such as the sensor's state."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=frames, note=note)
            return
        now = time.monotonic()
        if now - self._start_s > PATIENCE_S and (self._said_s == self._start_s or now - self._said_s > REPEAT_S):
            self._said_s = now
            total = f" of {self._total}" if self._total else ""
            sys.stderr.write(f"{self._what}: {frames}{total} frames {note}".rstrip() + "\n")

    def say(self, sentence: str) -> None:
        """Tell something at once, above the bar."""
        if self._bar is not None:
            self._bar.console.print(sentence, highlight=False)
        else:
            sys.stderr.write(f"{sentence}\n")

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if self._bar is not None:
            self._bar.stop()
