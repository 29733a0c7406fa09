"""Depth frames from a device, a recording, a folder or a virtual scene."""

from selective_depth.drivers.errors import SourceError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.drivers.source import DepthSource

__all__ = ["Camera", "DepthFrame", "DepthSource", "SourceError", "open_source"]
