"""What a depth source is: the protocol that devices, recordings and scenes share."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final, Self

from selective_depth.drivers.errors import SourceEndedError, SourceError
from selective_depth.drivers.frame import Camera, DepthFrame

DEFAULT_FPS: Final = 30.0
"""Frames per second where nothing is said."""


class DepthSource(ABC):
    """A stream of depth frames: a device, a recording or a virtual scene, all alike.

    Use it as a context manager; iterate over it for all frames, or call `read` for the next.

    Attributes
    ----------
    uri : str
        What was opened.
    camera : Camera
        Intrinsics and size of every frame.
    fps : float
        Nominal frame rate.
    frame_count : int or None
        Number of frames of a recording; None when live or endless.
    live : bool
        True if frames that are not read in time are lost, as with a device.
    dropped : int
        Frames that the sensor made and nobody read, so far.
    state : str
        ``"live"``; a sensor that can fail also says ``"stalled"`` (there, but silent),
        ``"lost"`` (not there) or ``"reconnecting"`` (there again, being opened).
    about : str
        What it is read as, in one sentence, where that is not plain; the first line of a run.
    notes : tuple of str
        What a user should know of it, a sentence each: what is missing, what was assumed.
    damage : str
        Why a recording is not whole, in a sentence, where that is known before its frames are read.
    tap : callable or None
        Of a live source: gets every frame that it makes, whether it is read or not, on the thread that
        takes them in: `OniRecorder.write`. It must be quick; it may be set and taken away at any time.
    """

    uri: str
    camera: Camera
    fps: float
    frame_count: int | None = None
    live: bool = False
    dropped: int = 0
    state: str = "live"
    about: str = ""
    notes: tuple[str, ...] = ()
    damage: str = ""
    tap: Callable[[DepthFrame], None] | None = None
    _opened_by: int

    def __new__(cls, *_: object, **__: object) -> Self:
        """Remember which process opens it."""
        source = super().__new__(cls)
        source._opened_by = os.getpid()
        return source

    def check_process(self) -> None:
        """Refuse to be read in a forked process; sources with a thread, a file or a child call it.

        Threads do not survive a fork, and two processes share the place in a file.

        Raises
        ------
        SourceError
            Saying to open the source where it is read.
        """
        if os.getpid() != self._opened_by:
            raise SourceError(
                f"'{self.uri}' was opened by another process, from which this one was forked; open"
                " it in the process that reads it."
            )

    @abstractmethod
    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame (a live source: the newest).

        Raises
        ------
        SourceEndedError
            After the last frame of a recording.
        SourceTimeoutError, DeviceLostError, DamagedRecordingError
            As their names say; frames already delivered stay good.
        """

    def read_as(self, what: str, values: str, camera_from: str, colour: str) -> str:
        """The `about` of a recording: what it is, what its values mean, where its camera and its colour come from."""
        lens = "fx {:g} fy {:g} cx {:g} cy {:g}".format(*self.camera.intrinsics)
        return f"'{self.uri}' is read as {what}: {values}; camera {lens} ({camera_from}){colour}."

    def skip(self, frames: int) -> None:
        """Leave out the next frames of a recording; raises as `read` does.

        Where a frame may depend on those before it, these are read for it.
        """
        for _ in range(frames):
            self.read()

    @abstractmethod
    def close(self) -> None:
        """Release the source. Harmless when called twice."""

    def __iter__(self) -> Iterator[DepthFrame]:
        with suppress(SourceEndedError):
            while True:
                yield self.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.close()


class RelayedSource(DepthSource):
    """One that plays the frames of another, which it owns: what is said of that one is said of it."""

    _source: DepthSource

    @property
    def about(self) -> str:  # type: ignore[override]
        """What the other is read as."""
        return self._source.about

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those of the other, so far."""
        return self._source.notes

    @property
    def damage(self) -> str:  # type: ignore[override]
        """That of the other, so far."""
        return self._source.damage
