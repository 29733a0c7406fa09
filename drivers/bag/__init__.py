"""ROS bags without ROS: ``.bag``, ROS 2 folders and ``.mcap``, by the optional package rosbags."""

from selective_depth.drivers.bag.reader import BagReader
from selective_depth.drivers.bag.writer import BagWriter

__all__ = ["BagReader", "BagWriter"]
