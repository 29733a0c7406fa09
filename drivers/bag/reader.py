"""Depth of ROS bags: raw images in mm or m, and compressedDepth, with their camera."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.bag.optional import readable, rosbags
from selective_depth.drivers.colour import CONVERSIONS, ON, Colouring, nearest, rgb_of, rgb_of_file
from selective_depth.drivers.errors import SourceEndedError, SourceError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthFrame, millimetres
from selective_depth.drivers.source import DepthSource

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA = "sensor_msgs/msg/CameraInfo"
_RAW = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
_COLOURS = {
    "rgb8": "RGB888", "bgr8": "BGR8", "rgba8": "RGBA8", "bgra8": "BGRA8", "mono8": "GRAY8", "yuv422": "YUV422",
    "yuv422_yuy2": "YUYV", "8UC3": "BGR8", "bayer_rggb8": "BAYER_RGGB8", "bayer_grbg8": "BAYER_GRBG8",
    "bayer_bggr8": "BAYER_BGGR8", "bayer_gbrg8": "BAYER_GBRG8",
}  # fmt: skip
"""ROS's names of colour encodings, as `colour` calls them."""
_INFRARED = ("infra", "/ir", "depth", "confidence", "left", "right", "fisheye")
_PNG = b"\x89PNG"


class BagReader(DepthSource):
    """Depth frames of a bag, each exactly once, in the order of the bag, with the colour beside them.

    Whole numbers are millimetres and floating point is metres, as ROS has it (REP 118), unless the
    bag says its unit, as RealSense's recorder does.

    Parameters
    ----------
    path : str or Path
        A ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 bag.
    topic : str, default ""
        Which topic; empty for the only one that carries depth.
    values_per_metre : float, optional
        Scale of whole numbers.
    intrinsics : (float, float, float, float), optional
        fx, fy, cx, cy in pixels; default those of the CameraInfo nearest in name, and in time to
        the first frame.
    colouring : Colouring, optional
        What is known of its colour; registered, by default, where the depth topic says so.

    Raises
    ------
    SourceNotFoundError
        If there is no such topic, or not exactly one depth topic.
    DamagedRecordingError
        If the bag cannot be read.
    SourceError
        If rosbags is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        topic: str = "",
        values_per_metre: float | None = None,
        intrinsics: tuple[float, ...] | None = None,
        colouring: Colouring = ON,
    ) -> None:
        self.uri = str(path)
        self.path = Path(path)
        self._next = 0
        self._bag: Any = None
        highlevel, types = rosbags("highlevel"), rosbags("typesys")
        try:
            with readable(self.path):
                store = types.get_typestore(types.Stores.ROS2_HUMBLE)
                self._bag = highlevel.AnyReader([self.path], default_typestore=store)
                self._bag.open()
                self._topic = topic = self._choose(topic)
                unit = self._depth_unit(topic)
                self.frame_count = self._bag.topics[topic].msgcount
                self._messages = self._of(topic)
                time_ns, first = next(self._of(topic))
                raw = self._raw(first)
                metres = raw.dtype.kind == "f"
                self._scale = values_per_metre or (1.0 if metres else unit or 1000.0)
                self.camera, camera_from = self._camera(raw.shape, intrinsics, time_ns)
                duration_s = self._bag.duration / 1e9
                self._open_colour(colouring, time_ns)
        except BaseException:
            self.close()
            raise
        rate = (self.frame_count - 1) / duration_s if duration_s > 0 else 0.0
        self.fps = rate if 0.01 < rate < 1000 else 30.0
        where = "as given" if values_per_metre else "as the bag says" if unit else "as ROS has it"
        what = "metres" if metres and self._scale == 1 else f"{self._scale:g} values a metre"
        colour = f"; colour from {self._colour_topic}" if self._colour_topic else ""
        self.about = self.read_as(f"a ROS bag, topic {topic}", f"{what} ({where})", camera_from, colour)

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame; see `DepthSource.read`."""
        self.check_process()
        if self._bag is None:
            raise SourceEndedError(f"'{self.uri}' has been closed.")
        with readable(self.path):
            following = next(self._messages, None)
            if following is None:
                raise SourceEndedError(f"'{self.uri}' has ended after {self._next} frames.")
            time_ns, message = following
            depth_mm = millimetres(self._raw(message), self._scale)
            frame = self._coloured(DepthFrame(depth_mm, self._next, time_ns // 1000, self.camera, self.uri))
        self._next += 1
        return frame

    def _open_colour(self, colouring: Colouring, time_ns: int) -> None:
        """Find the colour beside the depth: the image topic whose name has most in common with its."""
        found = [name for name in self._topics(_IMAGE, _COMPRESSED) if name != self._topic and self._is_colour(name)]
        nearest_name = min(found, key=lambda name: (-_shared(name, self._topic), name), default="")
        self._colour_topic = nearest_name if colouring.wanted else ""
        self._registered = any(word in self._topic for word in ("aligned_depth_to_color", "registered"))
        self._colours = self._of(self._colour_topic)
        self._around: deque[tuple[int, Any]] = deque(maxlen=2)
        if self._colour_topic:
            least = max(2, _shared(self._colour_topic, self._topic) + 1)  # else it may be the depth's
            _, _, told = self._info(self._colour_topic, least, time_ns)
            colouring = colouring.told_by(told)
        self._colouring = colouring

    def _coloured(self, frame: DepthFrame) -> DepthFrame:
        """A frame with the colour nearest to it in time."""
        while not self._around or self._around[-1][0] < frame.timestamp_us * 1000:
            following = next(self._colours, None)
            if following is None:
                break
            self._around.append(following)
        times_us = [time_ns // 1000 for time_ns, _ in self._around]
        at = nearest(times_us, frame.timestamp_us)
        if at is None:
            return frame
        message = self._around[at][1]
        if hasattr(message, "format"):
            colour = rgb_of_file(io.BytesIO(bytes(message.data)))
        else:
            kind = _COLOURS[message.encoding]
            colour = rgb_of(_rows(message, CONVERSIONS[kind][1]), kind, message.width, message.height)
        return frame if colour is None else self._colouring.colour(frame, colour, times_us[at], self._registered)

    def close(self) -> None:
        """Close the bag. Harmless when called twice."""
        if self._bag is not None:
            with suppress(Exception):  # of a bag that did not open
                self._bag.close()
            self._bag = None

    def _of(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Messages of a topic, each with the time at which it was taken."""
        wanted = [each for each in self._bag.connections if each.topic == topic]
        if not wanted:  # the package would take that for every topic
            return
        for connection, logged_ns, data in self._bag.messages(connections=wanted):
            message = self._bag.deserialize(data, connection.msgtype)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            taken_ns = stamp.sec * 10**9 + stamp.nanosec if stamp is not None else 0
            yield taken_ns or logged_ns, message

    def _choose(self, topic: str) -> str:
        if topic in self._bag.topics:
            return topic
        images = self._topics(_IMAGE, _COMPRESSED)
        if topic:
            there = ", ".join(images) or "none"
            raise SourceNotFoundError(f"'{self.uri}' has no topic '{topic}'; images: {there}.")
        found = [name for name in images if self._is_depth(name)]
        found = [name for name in found if name.rpartition("/")[0] not in found]  # raw, if both
        if len(found) == 1:
            return found[0]
        there = f"several: {', '.join(found)}" if found else f"none; images: {', '.join(images)}".rstrip(": ")
        raise SourceNotFoundError(
            f"'{self.uri}' does not have exactly one depth topic but {there}; name one with --topic."
        )

    def _topics(self, *types: str) -> list[str]:
        return [name for name, topic in self._bag.topics.items() if topic.msgtype in types]

    def _first(self, topic: str) -> Any:
        """The first message of a topic, None if there is none."""
        return next(self._of(topic), (0, None))[1]

    def _kind(self, topic: str) -> str:
        """What the images of a topic say that they are; empty if there are none."""
        message = self._first(topic)
        return str(getattr(message, "encoding", None) or getattr(message, "format", ""))

    def _is_depth(self, topic: str) -> bool:
        kind = self._kind(topic)
        infrared = kind == "mono16" and "depth" not in topic.lower()
        return not infrared and (kind in _RAW or "compressedDepth" in kind)

    def _is_colour(self, topic: str) -> bool:
        if any(part in topic.lower() for part in _INFRARED):
            return False
        kind = self._kind(topic)
        return kind in _COLOURS or "jp" in kind

    def _raw(self, message: Any) -> npt.NDArray[Any]:
        if hasattr(message, "format"):
            return _decompress(bytes(message.data), message.format)
        kind = _RAW.get(message.encoding)
        if kind is None:
            raise SourceNotFoundError(
                f"topic {self._topic} of '{self.uri}' holds {message.encoding}; depth is {', '.join(_RAW)}."
            )
        dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
        return _rows(message, dtype.itemsize).view(dtype).astype(kind)

    def _depth_unit(self, topic: str) -> float | None:
        """Values per metre, where RealSense's recorder has noted its unit."""
        message = self._first(f"{topic.partition('/Depth')[0]}/option/Depth_Units/value")
        return round(1 / message.data, 3) if message is not None and message.data > 0 else None

    def _camera(self, shape: tuple[int, ...], given: tuple[float, ...] | None, time_ns: int) -> tuple[Camera, str]:
        height, width = shape
        if given is not None:
            return Camera(width, height, *given), "as given"
        name, size, told = self._info(self._topic, 2, time_ns)
        if told and size == (width, height):
            return Camera(width, height, *told), name
        if name:
            self.notes += (
                f"{name} describes images of {size[0]}x{size[1]} pixels, not {width}x{height};"
                " it is not used. Give --camera fx,fy,cx,cy if you know them.",
            )
        return Camera.kinect(width, height), "assumed, a Kinect's"

    def _info(self, topic: str, least: int, time_ns: int) -> tuple[str, tuple[int, int], tuple[float, ...] | None]:
        """The CameraInfo whose name has most parts in common with a topic's, `least` or more, and nearest in time.

        Returns its topic (empty if there is none), the images' width and height, and their
        intrinsics where it tells any.
        """
        name = max(self._topics(_CAMERA), key=lambda name: _shared(name, topic), default="")
        if _shared(name, topic) < least:
            return "", (0, 0), None
        info = min(self._of(name), key=lambda item: abs(item[0] - time_ns))[1]
        k = [float(each) for each in (info.K if hasattr(info, "K") else info.k)]
        return name, (info.width, info.height), (k[0], k[4], k[2], k[5]) if k[0] > 0 else None


def _rows(message: Any, pixel_bytes: int) -> npt.NDArray[np.uint8]:
    """The bytes of an image message, row by row, without what pads its rows."""
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    return np.ascontiguousarray(rows[:, : message.width * pixel_bytes])


def _shared(one: str, other: str) -> int:
    """How many parts two topics' names have in common, from the first on."""
    pairs = zip(one.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _decompress(data: bytes, kind: str) -> npt.NDArray[Any]:
    """The image in a compressedDepth message: a header of 12 bytes, then PNG."""
    at = data.find(_PNG, 0, 64)
    raw = cv2.imdecode(np.frombuffer(data, np.uint8, offset=max(at, 0)), cv2.IMREAD_UNCHANGED)
    if at < 0 or raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        raise SourceError(f"a message in the format '{kind}' does not hold a 16-bit PNG; only those are read.")
    if "32FC1" not in kind:
        return raw
    near, far = (float(each) for each in np.frombuffer(data, "<f4", 2, 4))  # of inverse depth
    metres = near / (np.where(raw > 0, raw, np.inf) - far)
    return np.where(raw > 0, metres, np.nan).astype(np.float32)
