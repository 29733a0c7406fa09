"""A recording played from some frame on, one frame in so many, and again when it has ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from selective_depth.drivers.errors import SourceEndedError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import DepthSource, RelayedSource


class PlayedSource(RelayedSource):
    """Every n-th frame of a recording from one frame on; in a loop, its numbers and times go on.

    Parameters
    ----------
    source : DepthSource
        A recording. It is owned from here on and closed with this one.
    again : callable, optional
        Opens it anew, for the next time round; without, it is played once.
    start : int, default 0
        The first frame, from 0.
    every : int, default 1
        Of those that follow, one in so many.

    Raises
    ------
    SourceEndedError
        If it has no frame `start`.
    """

    def __init__(
        self, source: DepthSource, again: Callable[[], DepthSource] | None = None, *, start: int = 0, every: int = 1
    ) -> None:
        self._source, self._again, self._start, self._every = source, again, start, every
        self.uri, self.camera, self.fps = source.uri, source.camera, source.fps / every
        self.state = "replay"
        if again is None and source.frame_count is not None:
            self.frame_count = len(range(start, source.frame_count, every))
        self._index = self._time_us = 0  # by how much those of this time round are later
        self._last: DepthFrame | None = None
        self._frames_round = 0
        self._skip(start)

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame that is played; see `DepthSource.read`."""
        try:
            if self._frames_round and self._every > 1:
                self._source.skip(self._every - 1)
            frame = self._source.read(timeout_s)
        except SourceEndedError:
            if self._again is None or self._last is None:
                raise
            self._begin_again(self._last)
            frame = self._source.read(timeout_s)
        self._frames_round += 1
        if self._index:
            if self._frames_round == 1:
                self._time_us -= frame.timestamp_us
            frame = replace(frame, index=frame.index + self._index, timestamp_us=frame.timestamp_us + self._time_us)
        self._last = frame
        return frame

    def close(self) -> None:
        """Close the recording."""
        self._source.close()

    def _begin_again(self, last: DepthFrame) -> None:
        assert self._again is not None
        self._source.close()
        self._source = self._again()
        self._skip(self._start)
        self._frames_round = 0
        self._index = last.index + 1 - self._start
        self._time_us = last.timestamp_us + round(1e6 / self.fps)

    def _skip(self, frames: int) -> None:
        try:
            self._source.skip(frames)
        except SourceEndedError:
            there = "fewer" if self._source.frame_count is None else str(self._source.frame_count)
            self._source.close()
            raise SourceEndedError(
                f"--start is {frames}, but '{self.uri}' has {there} frames; the first is frame 0."
            ) from None
