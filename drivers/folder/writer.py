"""Writing recorded folders: frames as 16-bit PNG files, and the sidecar that explains them."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2

from selective_depth.drivers.errors import OutputError, unwritten
from selective_depth.drivers.folder.images import write_png
from selective_depth.drivers.folder.sidecar import MILLIMETRES, SIDECAR, Sidecar, write_sidecar
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import DEFAULT_FPS
from selective_depth.drivers.writer import FrameWriter, rate_of

COLOUR: Final = "colour"


class FolderWriter(FrameWriter):
    """Writes frames as a plain folder: ``000000.png`` …, colour in ``colour/``, and the sidecar.

    The sidecar is there from the first frame on and complete after `close`, so that what a killed
    program leaves can be read.

    Parameters
    ----------
    path : str or Path
        The folder; made if it is not there. It must not hold PNG files or a sidecar yet.
    fps : float, default 30
        Nominal frame rate, written to the sidecar.
    compression : int, default 3
        0 (fast, large) to 9 (slow, small).

    Raises
    ------
    OutputError
        If the folder cannot be made or written, or is in use.
    """

    def __init__(self, path: str | Path, *, fps: float = DEFAULT_FPS, compression: int = 3) -> None:
        self.path = Path(path)
        self._compression = compression
        self._sidecar = Sidecar(values_per_metre=MILLIMETRES, fps=float(fps))
        self._timestamps_us: list[int] = []
        self._colour_us: list[int] = []
        self._made = not self.path.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            used = any(entry.suffix.lower() == ".png" or entry.name == SIDECAR for entry in self.path.iterdir())
        except OSError as error:
            raise unwritten(self.path, error) from error
        if used:
            raise OutputError(f"'{self.path}' holds frames already; give a new or an empty folder.")

    def write(self, frame: DepthFrame) -> None:
        """Add a frame.

        Raises
        ------
        ValueError
            If the frame's camera differs from the first frame's.
        OutputError
            If it cannot be written, as on a full disk; the frames before it stay good.
        """
        if self._sidecar.camera is None:
            self._sidecar = replace(self._sidecar, camera=frame.camera)
            self._write_sidecar()
        elif frame.camera != self._sidecar.camera:
            raise ValueError(
                f"frame {frame.index} has {frame.camera}, but the folder '{self.path}' is of"
                f" {self._sidecar.camera}; write it to another folder"
            )
        if frame.colour is not None and self._sidecar.colour_registered is None:
            camera = None if frame.registered else frame.colour_camera
            self._sidecar = replace(self._sidecar, colour_registered=frame.registered, colour_camera=camera)
        depth, colour = self._files(len(self._timestamps_us))
        try:
            write_png(depth, frame.depth_mm, self._compression)
            if frame.colour is not None:
                colour.parent.mkdir(exist_ok=True)
                # Lossless, and as quick as it can be: noise hardly packs.
                write_png(colour, cv2.cvtColor(frame.colour, cv2.COLOR_RGB2BGR), 1)
        except OSError as error:
            # Half a file would make the whole folder unreadable.
            depth.unlink(missing_ok=True)
            colour.unlink(missing_ok=True)
            raise unwritten(depth, error) from error
        self._timestamps_us.append(frame.timestamp_us)
        self._colour_us.append(frame.colour_us or 0)

    def close(self) -> None:
        """Write the timestamps."""
        if self._timestamps_us:
            colour_us = None if self._sidecar.colour_registered is None else tuple(self._colour_us)
            self._sidecar = replace(
                self._sidecar, timestamps_us=tuple(self._timestamps_us), colour_timestamps_us=colour_us
            )
            self._write_sidecar()

    def discard(self) -> None:
        """Remove what was written, so that it is not in the way of the next attempt."""
        for index in range(len(self._timestamps_us)):
            for file in self._files(index):
                file.unlink(missing_ok=True)
        (self.path / SIDECAR).unlink(missing_ok=True)
        self._timestamps_us.clear()
        with suppress(OSError):  # somebody else has put something there meanwhile
            if (self.path / COLOUR).exists():
                (self.path / COLOUR).rmdir()
            if self._made:
                self.path.rmdir()

    def _files(self, index: int) -> tuple[Path, Path]:
        """Where a frame's depth and colour go."""
        name = f"{index:06d}.png"
        return self.path / name, self.path / COLOUR / name

    def _write_sidecar(self) -> None:
        try:
            write_sidecar(self.path, self._sidecar)
        except OSError as error:
            raise unwritten(self.path / SIDECAR, error) from error


def write_folder(
    path: str | Path, frames: Iterable[DepthFrame], *, fps: float | None = None, compression: int = 3
) -> int:
    """Save frames as a folder of 16-bit PNG files that `RecordedFolder` reads back bit by bit.

    Parameters
    ----------
    path : str or Path
        The folder; made if it is not there. It must not hold PNG files yet.
    frames : iterable of DepthFrame
        All of one camera; an open `DepthSource` is one.
    fps : float, optional
        Nominal frame rate; default that of the source, or 30.
    compression : int, default 3
        0 (fast, large) to 9 (slow, small).

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    return FolderWriter(path, fps=rate_of(frames, fps), compression=compression).write_all(frames)
