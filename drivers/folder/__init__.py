"""Recorded folders: depth frames as 16-bit PNG files with a sidecar, read and written."""

from selective_depth.drivers.folder.images import is_depth_png
from selective_depth.drivers.folder.layouts import find_layout
from selective_depth.drivers.folder.recorded import RecordedFolder
from selective_depth.drivers.folder.sidecar import SIDECAR
from selective_depth.drivers.folder.writer import FolderWriter, write_folder

__all__ = ["SIDECAR", "FolderWriter", "RecordedFolder", "find_layout", "is_depth_png", "write_folder"]
