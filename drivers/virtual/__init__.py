"""A virtual Kinect: scenes and objects, ray-cast, with a Kinect's noise."""

from selective_depth.drivers.virtual.objects import MeshSource
from selective_depth.drivers.virtual.source import VirtualSource

__all__ = ["MeshSource", "VirtualSource"]
