"""A sensor's numbers and times, made to go on rising."""

from __future__ import annotations

import time

from selective_depth.drivers.openni.process import Message


class Count:
    """Numbers and timestamps that go on rising when the sensor starts its own again."""

    def __init__(self) -> None:
        self._number = -1
        self._timestamp_us = 0
        self._seen_s = time.monotonic()
        self._add_number = 0
        self._add_us = 0
        self._fresh = True
        self.mended = 0

    def restart(self) -> None:
        """The next frame is the first of another run of the sensor."""
        self._fresh = True

    def follow(self, message: Message) -> tuple[int, int]:
        """Number and timestamp of a frame in the life of this source."""
        index, timestamp_us = int(message["index"]), int(message["timestamp_us"])
        now = time.monotonic()
        if self._fresh or index + self._add_number <= self._number:
            self._add_number = self._number + 1 - index
        # The outage takes as long on our clock as it took on the wall.
        away_us = max(round((now - self._seen_s) * 1e6), 1)
        step_us = timestamp_us + self._add_us - self._timestamp_us
        # A clock that stands, wraps round or counts milliseconds.
        wrong = step_us <= 0 or (away_us < 500_000 and step_us * 50 < away_us)
        if self._number >= 0 and (self._fresh or wrong):
            self.mended += not self._fresh
            self._add_us = self._timestamp_us + away_us - timestamp_us
        self._fresh = False
        self._seen_s = now
        self._number = index + self._add_number
        self._timestamp_us = timestamp_us + self._add_us
        return self._number, self._timestamp_us
