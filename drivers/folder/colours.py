"""Colour images beside the depth images of a recorded folder: which goes with which, and reading them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

from selective_depth.drivers.colour import Colouring, nearest, rgb_of_file
from selective_depth.drivers.folder.layouts import Found, stamps_of
from selective_depth.drivers.folder.sidecar import Sidecar
from selective_depth.drivers.frame import DepthFrame

SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".webp")


class Colours:
    """The colour images of a folder, one or none for each depth image.

    By an association list they go together as it says; by times, where both have some, the nearest
    within `colour.PAIR_US`; else those of the same numbers in their names.

    Parameters
    ----------
    found : Found
        The folder.
    sidecar : Sidecar
        What its sidecar says of the colour camera.
    colouring : Colouring
        What the user says of it.
    timestamps_us : sequence of int or None
        Times of the depth images.

    Attributes
    ----------
    about : str
        What is read, for a run's first line; empty where there is none.
    notes : tuple of str
        What a user should know.
    """

    def __init__(
        self, found: Found, sidecar: Sidecar, colouring: Colouring, timestamps_us: Sequence[int] | None
    ) -> None:
        self.about, self.notes = "", ()  # type: tuple[str, tuple[str, ...]]
        camera = sidecar.colour_camera
        told = (camera.fx, camera.fy, camera.cx, camera.cy) if camera else None
        self._colouring = colouring.told_by(told, sidecar.colour_place_mm)
        self._registered = found.row.registered if sidecar.colour_registered is None else sidecar.colour_registered
        self._files: list[Path | None] = []
        self._times_us = sidecar.colour_timestamps_us
        if not colouring.wanted:
            return
        images = _images(found)
        if found.colour is not None:
            self._files = [pair[1] if pair else None for pair in found.colour]
            self._times_us = tuple(pair[0] if pair else 0 for pair in found.colour)
        elif images:
            self._pair(found, images, timestamps_us)
        count = sum(each is not None for each in self._files)
        if not count:
            self._files = []
            return
        folder = next(each for each in self._files if each).parent
        self.about = f"; colour of {count} of {len(self._files)} frames from '{folder}'"
        if not (self._registered or self._colouring.registered or self._colouring.place_mm):
            self.notes = (
                "nothing says that its colour images lie on its depth images, so the cloud is not coloured;"
                " give --colour registered if they do, or the colour camera with --colour fx,fy,cx,cy,x,y,z.",
            )

    def on(self, frame: DepthFrame) -> tuple[DepthFrame, str]:
        """A frame with its colour, if it has any; and a sentence where that cannot be read."""
        path = self._files[frame.index] if self._files else None
        if path is None:
            return frame, ""
        colour = rgb_of_file(path)
        if colour is None:
            return frame, f"'{path}' cannot be read as a colour image; its frame has no colour."
        time_us = self._times_us[frame.index] if self._times_us else frame.timestamp_us
        return self._colouring.colour(frame, colour, time_us, self._registered), ""

    def _pair(self, found: Found, images: list[Path], depth_us: Sequence[int] | None) -> None:
        times = stamps_of(found.row, images) if found.timestamps_us else None
        if times and depth_us and self._times_us is None:
            order = sorted(range(len(images)), key=lambda k: times[k])
            rising = [times[k] for k in order]
            near = [nearest(rising, time_us) for time_us in depth_us]
            self._files = [None if k is None else images[order[k]] for k in near]
            self._times_us = tuple(0 if k is None else rising[k] for k in near)
        else:
            by_number = {_numbers(path): path for path in images}
            self._files = [by_number.get(_numbers(path)) for path in found.files]


def _images(found: Found) -> list[Path]:
    root = found.root.parent if found.row.name == "plain" and found.root.name == "depth" else found.root
    for pattern in found.row.colour.split("|") if found.row.colour else ():
        images = [path for path in root.glob(pattern) if path.suffix.lower() in SUFFIXES]
        if images:
            return images
    return []


def _numbers(path: Path) -> tuple[Decimal, ...]:
    return tuple(map(Decimal, re.findall(r"[0-9]+", path.stem)))
