"""Recording a live sensor to an `.oni` file, and making sure that it is all there."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni import OniRecorder
from selective_depth.drivers.openni.device import OpenNIDevice, parse_address

_BEAT_S = 0.1  # how often it is looked whether it is over


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
        Which sensor, with options as `parse_address` takes them; empty for the only one.
    frames : int, optional
        How many frames to record; default until stopped.
    duration_s : float, optional
        How long to record; default until stopped.
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
    address, settings = parse_address(device_uri)
    recorder = OniRecorder(out_path, overwrite=overwrite)
    taken = made = 0

    def take(frame: DepthFrame) -> None:
        nonlocal taken, made
        if frames is None or taken < frames:
            taken, made = taken + 1, max(made, frame.index + 1)
            recorder.write(frame)

    ended, told, started = "", 0, time.monotonic()

    def tell() -> None:
        nonlocal told
        while progress is not None and told < recorder.frames:
            told += 1
            progress(told)

    try:
        with OpenNIDevice(address, settings, tap=take) as device:
            started = time.monotonic()
            recorder.fps = device.fps
            try:
                while not ended:
                    device.wait(_BEAT_S)
                    ended = recorder.failure or _ended(device, taken, frames)
                    if duration_s is not None and time.monotonic() - started >= duration_s:
                        ended = ended or "done"
                    tell()
            except KeyboardInterrupt:
                ended = "interrupted"
    finally:
        problem = recorder.close()
        tell()
    seconds = time.monotonic() - started
    if made > taken and not problem:
        problem = f"{made - taken} frames that the sensor made did not arrive."
    ended = recorder.failure or ended
    return RecordingReport(recorder.path, recorder.frames, seconds, ended, problem)


def _ended(device: OpenNIDevice, taken: int, frames: int | None) -> str:
    """Why it is over; empty if it is not."""
    if frames is not None and taken >= frames:
        return "done"
    if device.state in ("lost", "reconnecting"):
        return f"the sensor is {device.state}: {device.state_reason}"
    return ""
