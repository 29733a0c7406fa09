"""Colour images beside the depth images of a recorded folder: which goes with which, and reading them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

from selective_depth.drivers.colour import Colouring, rgb_of_file
from selective_depth.drivers.folder.layouts import Found, nearest_images, stamps_of
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
        self._colouring = colouring.told_by(camera.intrinsics if camera else None, sidecar.colour_place_mm)
        self._registered = found.row.registered if sidecar.colour_registered is None else sidecar.colour_registered
        self._images = _paired(found, timestamps_us, sidecar.colour_timestamps_us) if colouring.wanted else []
        files = [image[1] for image in self._images if image]
        if not files:
            return
        self.about = f"; colour of {len(files)} of {len(self._images)} frames from '{files[0].parent}'"
        if not (self._registered or self._colouring.registered or self._colouring.place_mm):
            self.notes = (
                "nothing says that its colour images lie on its depth images, so the cloud is not coloured;"
                " give --colour registered if they do, or the colour camera with --colour fx,fy,cx,cy,x,y,z.",
            )

    def on(self, frame: DepthFrame) -> tuple[DepthFrame, str]:
        """A frame with its colour, if it has any; and a sentence where that cannot be read."""
        image = self._images[frame.index] if self._images else None
        if image is None:
            return frame, ""
        time_us, path = image
        colour = rgb_of_file(path)
        if colour is None:
            return frame, f"'{path}' cannot be read as a colour image; its frame has no colour."
        time_us = frame.timestamp_us if time_us is None else time_us
        return self._colouring.colour(frame, colour, time_us, self._registered), ""


def _paired(
    found: Found, depth_us: Sequence[int] | None, told_us: Sequence[int] | None
) -> Sequence[tuple[int | None, Path] | None]:
    """Time and image for each frame: times that are told go with the numbers in the names."""
    if found.colour is not None:
        return found.colour
    images = _images(found)
    times_us = stamps_of(found.row, images) if found.timestamps_us and told_us is None else None
    if times_us and depth_us:
        return nearest_images(list(zip(times_us, images, strict=True)), depth_us)
    by_number = {_numbers(path): path for path in images}
    own = [by_number.get(_numbers(path)) for path in found.files]
    return [(told_us[k] if told_us else None, path) if path else None for k, path in enumerate(own)]


def _images(found: Found) -> list[Path]:
    root = found.root.parent if found.row.name == "plain" and found.root.name == "depth" else found.root
    for pattern in found.row.colour.split("|") if found.row.colour else ():
        images = [path for path in root.glob(pattern) if path.suffix.lower() in SUFFIXES]
        if images:
            return images
    return []


def _numbers(path: Path) -> tuple[Decimal, ...]:
    return tuple(map(Decimal, re.findall(r"[0-9]+", path.stem)))
