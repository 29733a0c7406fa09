"""What the depth frames of an .oni file are: their size, camera, unit and side."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Final

import numpy as np

from selective_depth.drivers.frame import Camera, DepthArray
from selective_depth.drivers.oni.nodes import CAMERA, OniNode
from selective_depth.drivers.oni.records import CODEC_TABLE, DEPTH_CODECS, MAX_PAYLOAD, NodeType
from selective_depth.drivers.oni.report import OniReport

_MILLIMETRES, _TENTHS = 100, 101
"""OpenNI2's numbers of the pixel formats "depth in 1 mm" and "in 100 um"."""
_SHIFTS: Final = {102: "9.2", 103: "9.3"}
_LONGEST_GAP_US: Final = 1 << 40
_USUAL_INTERVAL_US: Final = 33_333


def read_form(report: OniReport, depth: OniNode) -> None:
    """Fill in how payloads of a depth stream become frames, after checking what the player relies on.

    Parameters
    ----------
    report : OniReport
        Gets their camera, rate and unit, what is done to them, whatever is wrong, and why they
        cannot be read.
    depth : OniNode
        The stream. Properties that are wrong are removed.
    """

    def problem(sentence: str) -> None:
        report.problem(depth.offset, sentence)

    mode = depth.values_of("xnMapOutputMode", "<III")
    if mode is None:
        problem("the frame size is not recorded")
        return
    width, height, fps = (int(value) for value in mode)
    if not (width and height and 2 * width * height <= MAX_PAYLOAD and 1 <= fps <= 1000):
        problem(f"the frames cannot be {width}x{height} at {fps} a second")
        return
    report.fps = fps
    pixels = depth.number_of("oniPixelFormat")
    if depth.codec not in DEPTH_CODECS:
        return
    if pixels in _SHIFTS:
        report.unsupported = f"its pixels are shifts in {_SHIFTS[pixels]}, which only its sensor turns into depth"
        return
    if pixels not in (None, _MILLIMETRES, _TENTHS):
        problem(f"the pixels have format {pixels}, which is not millimetres")
        return
    frame_bytes = depth.number_of("oniRequiredFrameSize")
    if frame_bytes not in (None, 2 * width * height):
        del depth.properties["oniRequiredFrameSize"]
        problem(f"frames of {width}x{height} do not have {frame_bytes} bytes")
    max_depth = depth.number_of("xnDeviceMaxDepth")
    if depth.codec == CODEC_TABLE and not 1 <= (max_depth or 0) < 65536:
        depth.properties.pop("xnDeviceMaxDepth", None)
        problem(f"the largest depth cannot be {max_depth} mm")
    notes = []
    sides = {frame.mirrored for frame in depth.frames}
    if True in sides:
        some = " in part (the side was switched while it recorded)" if len(sides) > 1 else ""
        notes.append(f"it is mirrored{some}; its frames are delivered the right way round")
    report.tenths = pixels == _TENTHS
    if report.tenths:
        reach = f" (beyond {max_depth / 10:g} mm its recorder falsifies)" if max_depth else ""
        notes.append(f"its unit is 0.1 mm; its frames are delivered in whole mm{reach}")
    try:
        camera = depth.camera(width, height)
    except (ValueError, ArithmeticError) as error:
        depth.properties.pop(CAMERA if CAMERA in depth.properties else "xnFOV", None)
        problem(f"the field of view is wrong: {error}")
        camera = None
    camera = camera or Camera.kinect(width, height)
    crop = depth.values_of("xnCropping", "<IHHHH")
    if crop is None:
        problem("the cropping is not recorded: OpenNI2 would deliver no frame at all")
    elif crop[0]:
        left, top, across, down = (int(value) for value in crop[1:])
        if not (0 < across <= width - left and 0 < down <= height - top):
            problem(f"{width}x{height} cannot be cropped to {crop[1:]}")
            return
        notes.append(f"it is cropped to {across}x{down} at {left}, {top}; its camera is shifted")
        left = width - left - across if sides == {True} else left
        camera = Camera(across, down, camera.fx, camera.fy, camera.cx - left, camera.cy - top)
    report.camera = camera
    report.notes += tuple(notes)


def upright(raw: DepthArray, tenths: bool, mirrored: bool) -> DepthArray:
    """Stored values as millimetres and the right way round."""
    depth_mm = (raw + np.uint32(5)) // 10 if tenths else raw
    return np.ascontiguousarray(depth_mm[:, ::-1] if mirrored else depth_mm, np.uint16)


class Sides:
    """Tells where frames turn into their mirror image from one to the next.

    OpenNI2's recorder does not note that its sensor's mirroring was switched. Nothing in front of a
    camera turns round between two frames: where a part of what both know changes by more than a
    twentieth, and of the mirrored frame hardly anything does, it was that.
    """

    def __init__(self) -> None:
        self.turns = 0
        self._last: DepthArray | None = None

    def put_right(self, depth_mm: DepthArray) -> DepthArray:
        """The next frame, on the side of the first."""
        other = np.ascontiguousarray(depth_mm[:, ::-1])
        now, turned = (other, depth_mm) if self.turns % 2 else (depth_mm, other)
        last, self._last = self._last, now
        changed = 0.0 if last is None else _changed(last, now)
        if last is not None and changed > 0.05 and _changed(last, turned) < changed / 3:
            self.turns += 1
            now = self._last = turned
        return now


def _changed(last: DepthArray, now: DepthArray) -> float:
    """Share of some pixels that differ by more than a twentieth, of those known in both frames."""
    stride = max(1, last.shape[1] // 160)
    before, after = (each[::stride, ::stride].astype(np.int32) for each in (last, now))
    known = (before > 0) & (after > 0)
    return float((known & (np.abs(after - before) * 20 > before)).sum() / max(known.sum(), 1))


def turned_at(number: int) -> str:
    """What is said of a recording that turns round at a frame."""
    return f"turns into its mirror image at frame {number}; all its frames are delivered the same way round."


def no_depth(nodes: Sequence[OniNode]) -> str:
    """Why a file without a depth frame holds none, naming what is there."""
    streams = [f"{node.name} ({len(node.frames)} frames)" for node in nodes if node.is_stream]
    there = f"; it holds {', '.join(streams)}" if streams else ""
    if any(node.node_type == NodeType.DEPTH for node in nodes):
        return f"its depth stream never gave a frame{there}"
    return f"no depth was recorded{there}"


def mended_times(times_us: list[int]) -> tuple[list[int], int | None]:
    """Timestamps that never run backwards, and the index of the first that had to be mended.

    A single value that breaks the order is put between its neighbours. Where the clock jumps back
    (a sensor that was opened anew; OpenNI2 writes times near 2^64 then), time goes on from there.
    """
    times = [t - (1 << 64) if t >= 1 << 63 else t for t in times_us]
    for at in range(len(times) - 1):
        before, now, after = times[at - 1] if at else times[1], times[at], times[at + 1]
        if not before <= now <= after and before <= after and (at or now > after):
            times[at] = (before + after) // 2 if at else after
    intervals = [after - before for before, after in pairwise(times)]
    sound = [interval for interval in intervals if 0 < interval <= _LONGEST_GAP_US]
    usual_us = round(median(sound)) if sound else _USUAL_INTERVAL_US
    mended = times[:1] if times and abs(times[0]) < 1 << 61 else [0][: len(times)]
    for interval in intervals:
        mended.append(mended[-1] + (interval if 0 <= interval <= _LONGEST_GAP_US else usual_us))
    differ = (n for n, time_us in enumerate(times_us) if mended[n] != time_us)
    return mended, next(differ, None)
