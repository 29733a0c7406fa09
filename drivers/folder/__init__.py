"""Recorded folders: depth frames as 16-bit PNG files with a sidecar, read and written."""

from selective_depth.drivers.folder.recorded import RecordedFolder
from selective_depth.drivers.folder.writer import FolderWriter, write_folder

__all__ = ["FolderWriter", "RecordedFolder", "write_folder"]
