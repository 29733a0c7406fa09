"""What a source delivers, told as it comes: frames, silences, changes of state, and the end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

from selective_depth.app.console import interrupt
from selective_depth.app.pipeline.report import say
from selective_depth.drivers.errors import DamagedRecordingError, DeviceLostError, SourceEndedError, SourceTimeoutError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.drivers.source import DepthSource


def open_and_tell(uri: str) -> DepthSource:
    """Open a source and say first what it is read as, where its own name does not tell."""
    source = open_source(uri)
    if source.about:
        say(source.about)
    return source


POLL_S = 0.5
"""How long a live sensor may be silent before its state is shown."""


class Read(NamedTuple):
    """What one look at a source found."""

    frame: DepthFrame | None
    """The next frame; None where a sensor was silent."""
    state: str
    """The source's: live, stalled, lost, reconnecting; or replay."""
    read_ms: float
    """How long it was waited for."""


def state_of(source: DepthSource) -> str:
    """The state of a source, for people: that of a sensor, or that it is a replay."""
    return "replay" if source.frame_count is not None else source.state


class Feed:
    """Reads a source to its end, a number of frames, or the place where it is damaged.

    Parameters
    ----------
    source : DepthSource
        Where frames come from; it stays its owner's to close.
    frames : int, optional
        At most so many.

    Attributes
    ----------
    frames : int or None
        At most so many; may be changed on the way.
    damage : DamagedRecordingError or None
        What ended it before the end of the recording.
    """

    def __init__(self, source: DepthSource, frames: int | None = None) -> None:
        self.damage: DamagedRecordingError | None = None
        self._source = source
        self.frames = frames

    def __iter__(self) -> Iterator[Read]:
        source, taken = self._source, 0
        while taken != self.frames:
            interrupt.check()
            start_s = time.perf_counter()
            frame = None
            try:
                frame = source.read(POLL_S) if source.live else source.read()
            except SourceEndedError:
                return
            except DamagedRecordingError as error:
                self.damage = error
                return
            except (SourceTimeoutError, DeviceLostError):
                if not source.live:
                    raise
            if frame is not None:
                taken += 1
                if not source.live and source.tap is not None:
                    source.tap(frame)
            yield Read(frame, state_of(source), (time.perf_counter() - start_s) * 1000)
