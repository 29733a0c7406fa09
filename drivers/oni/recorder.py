"""Recording frames as they come, in a thread of its own, each proved to be in the file."""

from __future__ import annotations

import queue
import shutil
import threading
from pathlib import Path

import numpy as np

from selective_depth.drivers.errors import OutputError, SourceError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni.inspection import inspect_oni
from selective_depth.drivers.oni.writer import OniWriter

RESERVE_BYTES = 16 << 20
"""Room that is left on a disk, for the end of the file and for everything else."""
_WAITING = 120  # frames in memory while the disk is busy: 4 s of them, 74 MB


class OniRecorder:
    """Writes the frames of a sensor to an .oni file without keeping the sensor waiting.

    Every frame is read back from the file and compared with the one that was handed over. The file
    begins with the first frame; whatever ends the program, it is readable as far as it goes.

    Parameters
    ----------
    path : str or Path
        The file, ending in ``.oni``.
    fps : float, default 30
        Nominal frame rate.
    overwrite : bool, default False
        Whether a file of that name is replaced, once there is a frame.

    Attributes
    ----------
    frames : int
        How many are in the file, the same as they were handed over.
    missed : int
        How many were not taken, since the disk was too slow.
    failure : str
        What ended it early; empty if nothing did.

    Raises
    ------
    OutputError
        If nothing can be written to that place, or there is something already.
    """

    def __init__(self, path: str | Path, *, fps: float = 30.0, overwrite: bool = False) -> None:
        self.path = Path(path)
        self.fps = fps
        self.frames = self.missed = 0
        self.failure = ""
        self._overwrite = overwrite
        check_place(self.path, overwrite)
        self._waiting: queue.Queue[DepthFrame | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._run, name="oni-recorder", daemon=True)
        self._thread.start()

    def write(self, frame: DepthFrame) -> None:
        """Hand a frame over; it is on the disk a little later."""
        try:
            self._waiting.put_nowait(frame)
        except queue.Full:
            self.missed += 1

    def close(self) -> str:
        """Finish the file.

        Returns
        -------
        str
            What is wrong with the recording, and what to do; empty if every frame that was handed
            over is in it, unchanged.
        """
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        if not self.frames:
            return f"'{self.path}' holds no frame."
        report = inspect_oni(self.path)
        if not report.complete or report.readable_frames != self.frames:
            return (
                f"'{self.path}' is not whole: it has {report.readable_frames} frames of {self.frames}. `selective-depth"
                f" check '{self.path}' --repair OUT.oni` saves those."
            )
        if self.missed:
            return f"{self.missed} frames are not in it: the disk was too slow."
        return ""

    def _run(self) -> None:
        writer: OniWriter | None = None
        try:
            while (frame := self._waiting.get()) is not None:
                if self.failure:
                    continue  # whoever feeds it must not wait for a thread that is gone
                try:
                    if writer is None:
                        if self._overwrite:
                            self.path.unlink(missing_ok=True)
                        writer = OniWriter(self.path, fps=self.fps, keep=True)
                    self._write(writer, frame)
                except (SourceError, ValueError, OSError) as error:
                    self.failure = str(error).rstrip(".")
        finally:
            if writer is not None:
                try:
                    writer.close()
                except OutputError as error:
                    self.failure = self.failure or str(error).rstrip(".")

    def _write(self, writer: OniWriter, frame: DepthFrame) -> None:
        if shutil.disk_usage(self.path.parent).free < RESERVE_BYTES:
            raise OutputError("the disk is full")
        writer.write(frame)
        there = writer.read_back()
        if there is None or not np.array_equal(there, frame.depth_mm):
            raise OutputError(f"frame {frame.index} came back from the disk changed; is the disk in order?")
        self.frames += 1


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse a place where nothing can be recorded, before there is anything to record.

    Raises
    ------
    OutputError
        Naming it, and what to do.
    """
    if path.suffix.lower() != ".oni":
        raise OutputError(f"'{path}' must end in .oni to be a recording.")
    if path.is_dir():
        raise OutputError(f"'{path}' is a folder. Give the name of a file in it.")
    if not overwrite and path.exists() and path.stat().st_size > 0:
        raise OutputError(f"'{path}' exists already. Give another name, or --overwrite.")
    unborn = path.with_name(f"{path.name}.part")
    try:
        free_bytes = shutil.disk_usage(path.parent).free
        if free_bytes < 2 * RESERVE_BYTES:
            raise OutputError(
                f"'{path}' cannot be recorded: {free_bytes >> 20} MB are free there, and a minute"
                " takes about 200 MB. Give another place."
            )
        unborn.touch()
        unborn.unlink()
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}. Give a place that can.") from error
