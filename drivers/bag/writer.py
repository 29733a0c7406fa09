"""Writing frames as a ROS 2 bag: one .mcap file, or the folder that ROS 2 records."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from selective_depth.drivers.bag.optional import rosbags
from selective_depth.drivers.errors import OutputError, unwritten
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.writer import FrameWriter

TOPIC = "/camera/depth/image_rect_raw"
ALIGNED = "/camera/aligned_depth_to_color/image_raw"
_FRAME = "camera_depth_optical_frame"
_COLOUR_TOPIC = "/camera/color/image_raw"


class BagWriter(FrameWriter):
    """Writes frames as ``sensor_msgs/Image`` with their CameraInfo: depth as 16UC1 in millimetres, colour as rgb8.

    Where colour lies on depth, the topic's name says so, as RealSense's does.

    Parameters
    ----------
    path : str or Path
        A file that ends in ``.mcap``, or a folder for a ROS 2 bag (SQLite). Must not exist; it is
        there once `close` has ended it.

    Raises
    ------
    OutputError
        If it exists, or cannot be written.
    SourceError
        If rosbags is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._unborn = self.path.with_name(f"{self.path.name}.part")
        self._mcap = self.path.suffix.lower() == ".mcap"
        if self.path.exists():
            raise OutputError(f"'{self.path}' exists already; give another name, or remove it.")
        types, library = rosbags("typesys"), rosbags("rosbag2")
        self._store: Any = types.get_typestore(types.Stores.ROS2_HUMBLE)
        kind = library.StoragePlugin.MCAP if self._mcap else library.StoragePlugin.SQLITE3
        try:
            shutil.rmtree(self._unborn, ignore_errors=True)  # what a killed program left
            self._writer: Any = library.Writer(self._unborn, version=8, storage_plugin=kind)
            self._writer.open()
        except (OSError, library.WriterError) as error:
            raise unwritten(self.path, error) from error
        self._topics: dict[str, Any] = {}
        self._count = 0

    def write(self, frame: DepthFrame) -> None:
        """Add a frame.

        Raises
        ------
        ValueError
            If its time is negative, which ROS cannot say.
        OutputError
            If it cannot be written, as on a full disk.
        """
        if frame.timestamp_us < 0:
            raise ValueError(f"frame {frame.index} has the time {frame.timestamp_us} us; ROS has none before 0")
        if self._count == 0:
            self._depth_topic = ALIGNED if frame.colour is not None and frame.registered else TOPIC
        data = frame.depth_mm.astype("<u2").reshape(-1).view(np.uint8)
        self._put_image(self._depth_topic, frame.timestamp_us, frame.shape, "16UC1", data, frame.camera)
        if frame.colour is not None and (frame.colour_us or 0) >= 0:
            shape = frame.colour.shape[:2]
            self._put_image(
                _COLOUR_TOPIC, frame.colour_us or 0, shape, "rgb8", frame.colour.reshape(-1), frame.colour_camera
            )
        self._count += 1

    def _put_image(
        self, topic: str, time_us: int, shape: tuple[int, ...], encoding: str, data: Any, camera: Camera | None
    ) -> None:
        types = self._store.types
        seconds, rest_us = divmod(time_us, 1_000_000)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest_us * 1000)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=_FRAME)
        height, width = shape
        image = types["sensor_msgs/msg/Image"](
            header, height, width, encoding=encoding, is_bigendian=0, step=data.size // height, data=data
        )
        if camera is not None:
            self._put(f"{topic.rpartition('/')[0]}/camera_info", time_us, self._info(header, camera), "CameraInfo")
        self._put(topic, time_us, image, "Image")

    def close(self) -> None:
        """Finish the bag and give it its name; without a frame there is none."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        try:
            writer.close()
            if self._count:
                inner = next(self._unborn.glob("*.mcap")) if self._mcap else self._unborn
                inner.replace(self.path)
        except OSError as error:
            raise unwritten(self.path, error) from error
        finally:
            shutil.rmtree(self._unborn, ignore_errors=True)

    def discard(self) -> None:
        """Leave nothing: what was written has no name before `close`, and without a frame it gets none."""
        self._count = 0

    def _put(self, topic: str, timestamp_us: int, message: Any, kind: str) -> None:
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=self._store)
        connection = self._topics[topic]
        data = self._store.serialize_cdr(message, connection.msgtype)
        try:
            self._writer.write(connection, timestamp_us * 1000, data)
        except OSError as error:
            raise unwritten(self.path, error) from error

    def _info(self, header: Any, camera: Camera) -> Any:
        types = self._store.types
        k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], np.float64)
        p = np.array([*k[:3], 0, *k[3:6], 0, *k[6:], 0], np.float64)
        return types["sensor_msgs/msg/CameraInfo"](
            header, camera.height, camera.width, distortion_model="plumb_bob", d=np.zeros(5), k=k,
            r=np.eye(3).reshape(-1), p=p, binning_x=0, binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        )  # fmt: skip
