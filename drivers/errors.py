"""What can go wrong with a depth source, one named error a kind."""

from __future__ import annotations

from pathlib import Path


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


def unwritten(path: Path, error: Exception) -> OutputError:
    """The error of a recording that cannot be written: why, and what to look at."""
    why = getattr(error, "strerror", None) or str(error)
    return OutputError(f"'{path}' cannot be written ({why}); check the folder, its permissions and the free space.")
