"""What a depth source is, how one is opened, and what can go wrong with it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from selective_depth.drivers.frame import Camera, DepthFrame


class SourceError(Exception):
    """Something is wrong with a depth source; the message says what, where and what next."""


class SourceNotFoundError(SourceError):
    """No such file, folder, scene or device."""


class RuntimeMissingError(SourceError):
    """The OpenNI2 runtime is not installed or cannot be loaded."""


class DeviceRefusedError(SourceError):
    """The device is there but does not serve: busy, no permission, wrong mode, no start."""


class DeviceLostError(SourceError):
    """The device was there and is not any more; a live source goes on looking for it."""


class SourceTimeoutError(SourceError):
    """No frame arrived within the stated time; the source may still recover."""


class DamagedRecordingError(SourceError):
    """A recording cannot be read, or not beyond a certain frame."""


class OutputError(SourceError):
    """A recording or an export cannot be written (disk full, no permission, already there)."""


class SourceEndedError(SourceError):
    """Every frame of a recording has been delivered. The normal end, not a fault."""


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
    """

    uri: str
    camera: Camera
    fps: float
    frame_count: int | None
    live: bool
    dropped: int
    state: str = "live"

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

    @abstractmethod
    def close(self) -> None:
        """Release the source. Harmless when called twice."""

    def __iter__(self) -> Iterator[DepthFrame]:
        while True:
            try:
                frame = self.read()
            except SourceEndedError:
                return
            yield frame

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


_WHAT_THERE_IS = (
    "Give an .oni file, a folder of 16-bit PNG frames, 'openni' for a sensor, or"
    " 'virtual:workstation'."
)


def open_source(uri: str | Path) -> DepthSource:
    """Open any depth source by its name.

    Parameters
    ----------
    uri : str or Path
        ``openni`` or ``openni:<device uri>``, a live sensor through OpenNI2;
        ``<file>.oni``, a recording, replayed frame by frame;
        ``<folder>``, 16-bit PNG frames (plain, TUM, 7-Scenes or Redwood layout);
        ``virtual:<scene>``, a virtual Kinect in a made scene, with options after ``?``;
        ``<file>.ply``, an object seen from a chosen side.

    Raises
    ------
    SourceError
        One of its named kinds; the message says what was tried and what to do next.
    """
    # Each kind is imported where it is opened: a PNG folder must not need OpenNI2, and
    # `--help` must not wait for numba.
    name = str(uri)
    if not name:  # which a path would take for this folder
        raise SourceNotFoundError(f"a source with no name was given. {_WHAT_THERE_IS}")
    scheme, _, rest = name.partition(":")
    if name == "openni" or scheme == "openni":
        from selective_depth.drivers.openni import OpenNIDevice

        return OpenNIDevice(rest)
    if scheme == "virtual":
        from selective_depth.drivers.virtual import VirtualSource

        return VirtualSource(rest)
    path = Path(name.partition("?")[0]) if not Path(name).exists() else Path(name)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        from selective_depth.drivers.mesh import MeshSource

        return MeshSource(name)
    if path.is_dir():
        from selective_depth.drivers.recorded import RecordedFolder

        return RecordedFolder(path)
    if suffix == ".oni":
        from selective_depth.drivers.oni_reader import OniReader
        from selective_depth.drivers.openni import OpenNIRecording

        try:
            return OpenNIRecording(path)
        except RuntimeMissingError:
            return OniReader(path)  # the same frames, without OpenNI2
    if not path.exists():
        raise SourceNotFoundError(f"'{name}' does not exist. {_WHAT_THERE_IS}")
    raise SourceNotFoundError(
        f"'{name}' is no depth source: a recording ends in .oni, an object in .ply, and PNG frames"
        " are given by their folder."
    )
