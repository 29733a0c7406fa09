"""What all recordings that frames are written to have in common: they are whole, or not there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Self

from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import DEFAULT_FPS, DepthSource


class FrameWriter(ABC):
    """Writes frames to a recording. As a context manager it leaves nothing where writing failed."""

    @abstractmethod
    def write(self, frame: DepthFrame) -> None:
        """Add a frame.

        Raises
        ------
        ValueError
            If the recording cannot hold such a frame.
        OutputError
            If it cannot be written, as on a full disk.
        """

    @abstractmethod
    def close(self) -> None:
        """Finish the recording. Harmless when called twice."""

    @abstractmethod
    def discard(self) -> None:
        """Leave nothing of what was written, so that it is not in the way of the next attempt."""

    def write_all(self, frames: Iterable[DepthFrame]) -> int:
        """Write frames and finish; their number is returned."""
        count = 0
        with self:
            for frame in frames:
                self.write(frame)
                count += 1
        return count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, OutputError | ValueError):
            self.discard()  # a source that failed leaves what it gave; a writer, nothing
        self.close()


def rate_of(frames: Iterable[DepthFrame], fps: float | None) -> float:
    """The frame rate that was given, or else that of the source that frames come from, or else 30."""
    if fps is not None:
        return fps
    return frames.fps if isinstance(frames, DepthSource) else DEFAULT_FPS
