"""Recording a live sensor to an `.oni` file, and making sure that it is all there."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from selective_depth.drivers.errors import DeviceRefusedError, OutputError
from selective_depth.drivers.oni import inspect_oni, mend_oni
from selective_depth.drivers.openni.device import DeviceSettings
from selective_depth.drivers.openni.process import Worker, error_of

_OPEN_S = 10.0  # a sensor that loads its firmware takes seconds
_STALL_S = 5.0  # silence of the sensor after which a recording is ended
_HANG_S = 5.0  # silence of the worker, which reports five times a second
_SAVE_S = 10.0  # for the recorder to write what it still holds
_RESERVE_BYTES = 16 << 20  # a recording ends while there is still room for the end of its file


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """What became of a recording.

    Parameters
    ----------
    path : Path
        The file.
    frames : int
        Frames in it, counted by opening it again.
    seconds : float
        How long was recorded, from the sensor's start to the file's end.
    ended : str
        ``"done"``, ``"interrupted"`` or, in words, what ended it early.
    problem : str
        What is wrong with the file, and what to do; empty if it is all there.
    """

    path: Path
    frames: int
    seconds: float
    ended: str
    problem: str


def record(
    out_path: str | Path,
    device_uri: str = "",
    *,
    frames: int | None = None,
    duration_s: float | None = None,
    settings: DeviceSettings | None = None,
    progress: Callable[[int], None] | None = None,
    overwrite: bool = False,
) -> RecordingReport:
    """Record a live sensor until there are enough frames, or Ctrl-C.

    Ctrl-C ends the recording properly: the report says ``"interrupted"``, and it is for the
    caller to end with the exit code that this means. A full disk, a file that does not grow, a
    sensor that stalls or goes end it as well, with what is there so far.

    Parameters
    ----------
    out_path : str or Path
        The file to make, ending in ``.oni``.
    device_uri : str, default ""
        Which sensor; empty for the only one.
    frames : int, optional
        How many frames to record; default until stopped.
    duration_s : float, optional
        How long to record; default until stopped.
    settings : DeviceSettings, optional
        How to set the sensor up. Its `mirror` does not matter: recordings are as seen.
    progress : callable, optional
        Called with the number of frames so far, some times a second.
    overwrite : bool, default False
        Whether a recording of that name may be replaced.

    Raises
    ------
    OutputError
        If nothing can be written to that place, or there is something already.
    SourceNotFoundError, RuntimeMissingError, DeviceRefusedError
        As for `OpenNIDevice`.
    """
    path = Path(out_path)
    # Under another name until the sensor streams: an older recording is not lost for nothing.
    unborn = path.parent / f"{path.name}.part"
    file = _create(path, unborn, overwrite)
    try:
        worker = Worker(
            "record",
            keep_open=(file,),
            uri=device_uri,
            like=None,
            settings=asdict(settings or DeviceSettings()),
            file=file,
            path=str(unborn),
            frames=frames,
            duration_s=duration_s,
            stall_s=_STALL_S,
            reserve_bytes=_RESERVE_BYTES,
        )
        try:
            _wait_for_stream(worker)
            unborn.replace(path)
            started = time.monotonic()
            ended, seen = _follow(worker, progress)
            seconds = time.monotonic() - started
        finally:
            worker.close(grace_s=1.0)
    finally:
        os.close(file)
        unborn.unlink(missing_ok=True)
    counted, problem = _verify(path, seen)
    return RecordingReport(path, counted, seconds, ended, problem)


def _create(path: Path, unborn: Path, overwrite: bool) -> int:
    if sys.platform == "win32":
        raise OutputError("Recording works on Linux and macOS; on Windows record with NiViewer.")
    if path.suffix.lower() != ".oni":
        raise OutputError(f"'{path}' must end in .oni to be a recording.")
    if path.is_dir():
        raise OutputError(f"'{path}' is a folder. Give the name of a file in it.")
    if not overwrite and path.exists() and path.stat().st_size > 0:
        raise OutputError(f"'{path}' exists already. Give another name, or --overwrite.")
    try:
        free_bytes = shutil.disk_usage(path.parent).free
        if free_bytes < 2 * _RESERVE_BYTES:
            raise OutputError(
                f"'{path}' cannot be recorded: {free_bytes >> 20} MB are free there, and a minute"
                " takes about 200 MB. Give another place."
            )
        return os.open(unborn, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}. Give a place that can.") from error


def _wait_for_stream(worker: Worker) -> None:
    """Wait until the sensor streams into the recorder."""
    while True:
        message = worker.receive(_OPEN_S)
        if message is None:
            raise DeviceRefusedError(f"The sensor does not open: OpenNI2 hangs for {_OPEN_S:g} s.")
        if message["kind"] == "error":
            raise error_of(message)
        if message["kind"] == "died":
            raise DeviceRefusedError(f"The sensor does not open: {message['reason']}.")
        if message["kind"] == "opened":
            return


def _follow(worker: Worker, progress: Callable[[int], None] | None) -> tuple[str, int]:
    """Wait until the file is saved; say what ended it and how many frames were seen."""
    interrupted = False
    seen = 0
    while True:
        patience_s = _SAVE_S if interrupted else _HANG_S
        try:
            message = worker.receive(patience_s)
            if message is None:
                return f"OpenNI2 hangs for {patience_s:g} s", seen
            if message["kind"] == "died":
                return str(message["reason"]), seen
            if message["kind"] == "error":
                return str(message["message"]), seen
            if message["kind"] == "saved":
                return "interrupted" if interrupted else str(message["ended"]), seen
            seen = int(message["frames"])
            if progress is not None:
                progress(seen)
        except KeyboardInterrupt:
            if interrupted:
                raise
            interrupted = True
            worker.stop()


def _verify(path: Path, seen: int) -> tuple[int, str]:
    """Tidy up a finished recording, decode its frames, and have OpenNI2 itself open it again."""
    report = inspect_oni(path, decode=True)
    frames = report.readable_frames
    if frames == 0:
        return 0, f"'{path}' holds no frame."
    if not report.complete:
        what = f" ({report.problems[0].sentence.rstrip('.')})" if report.problems else ""
        return frames, (
            f"'{path}' is not whole{what}. `selective-depth check '{path}' --repair"
            f" OUT.oni` saves its {frames} frames."
        )
    # The recorder leaves as many zeros after the end as there are bytes before it.
    os.truncate(path, report.size_bytes - report.tail_bytes)
    # It also swaps two bytes of frames that end in a certain way; players would show that.
    mend_oni(path)
    if frames < seen:
        return frames, f"'{path}' has {frames} frames; the sensor made {seen}."
    return frames, ""
