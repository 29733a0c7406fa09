"""Which colour image goes with which depth frame of a live sensor: the nearest in time."""

from __future__ import annotations

import time
from collections import deque
from typing import Final

from selective_depth.drivers.colour import PAIR_US, Colouring
from selective_depth.drivers.frame import ColourArray, DepthFrame

_TOGETHER_US: Final = 3_000
"""Colour that is no older than this against depth is of the same moment: nothing nearer will come."""
_START_S: Final = 1.0
"""How long the first frame waits for colour, which starts later with many sensors."""
_PATIENCE_S: Final = 0.03
"""How long a frame waits for colour that is under way; the next depth frame ends it too."""
_STOPPED_S: Final = 1.0
_ALONE: Final = 60
"""So many frames in a row whose colour is of another moment are no accident."""


class Pairing:
    """Hands depth frames on, each with its colour, a little later than they came.

    OpenNI2 can hold both streams back until they fit, but then depth stands still where colour
    does: so they are put together here.

    Parameters
    ----------
    expected : bool
        Whether the sensor sends colour.
    registered : bool
        Whether it says that colour lies on depth.
    colouring : Colouring
        What the user says of it.

    Attributes
    ----------
    trouble : str
        Why frames have no colour though it was expected; empty while they have.
    """

    def __init__(self, expected: bool, registered: bool, colouring: Colouring) -> None:
        self.trouble = ""
        self._expected, self._registered, self._colouring = expected, registered, colouring
        self._colours: deque[tuple[int, ColourArray]] = deque(maxlen=2)
        self._waiting: tuple[DepthFrame, int] | None = None
        self._begun_s: float | None = None
        self._heard_s = self._came_s = 0.0
        self._alone = 0

    def colour(self, image: ColourArray, sensor_us: int) -> list[DepthFrame]:
        """Take a colour image in; the frame that waited for it, if one did."""
        self._colours.append((sensor_us, image))
        self._heard_s = time.monotonic()
        return self._go() if self._waiting and sensor_us >= self._waiting[1] - _TOGETHER_US else []

    def depth(self, frame: DepthFrame, sensor_us: int) -> list[DepthFrame]:
        """Take a depth frame in, with its time as the sensor told it; frames that are ready, in order."""
        if not self._expected:
            return [frame]
        now_s = time.monotonic()
        self._begun_s = self._begun_s or now_s
        if not self._colours and now_s - self._begun_s < _START_S:
            return []
        ready = self._go()
        self._waiting, self._came_s = (frame, sensor_us), now_s
        stopped = now_s - max(self._heard_s, self._begun_s) > _STOPPED_S
        if stopped:
            self._colours.clear()
            self.trouble = "it sends no colour; depth goes on"
        if stopped or (self._colours and self._colours[-1][0] >= sensor_us - _TOGETHER_US):
            ready += self._go()
        return ready

    @property
    def waits(self) -> bool:
        """Whether a frame waits for its colour."""
        return self._waiting is not None

    def late(self) -> list[DepthFrame]:
        """A frame that has waited long enough."""
        return self._go() if self._waiting and time.monotonic() - self._came_s > _PATIENCE_S else []

    def restart(self) -> None:
        """The sensor begins anew."""
        self._colours.clear()
        self._waiting = self._begun_s = None

    def _go(self) -> list[DepthFrame]:
        if self._waiting is None:
            return []
        (frame, sensor_us), self._waiting = self._waiting, None
        time_us, image = min(self._colours, key=lambda pair: abs(pair[0] - sensor_us), default=(0, None))
        if image is None:
            return [frame]
        if abs(time_us - sensor_us) > PAIR_US:
            self._alone += 1
            if self._alone == _ALONE:
                away_ms = (time_us - sensor_us) / 1000
                self.trouble = f"its colour is {away_ms:.0f} ms away from depth by its own clock and is left out"
            return [frame]
        self._alone = 0
        self.trouble = ""
        return [self._colouring.colour(frame, image, frame.timestamp_us + time_us - sensor_us, self._registered)]
