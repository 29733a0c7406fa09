"""`.oni` recordings without OpenNI2: inspected, read, written and repaired."""

from selective_depth.drivers.oni.form import upright
from selective_depth.drivers.oni.inspection import inspect_oni
from selective_depth.drivers.oni.reader import OniReader
from selective_depth.drivers.oni.recorder import OniRecorder, check_place
from selective_depth.drivers.oni.repair import repair_oni
from selective_depth.drivers.oni.report import OniReport
from selective_depth.drivers.oni.writer import OniWriter, write_oni

__all__ = [
    "OniReader",
    "OniRecorder",
    "OniReport",
    "OniWriter",
    "check_place",
    "inspect_oni",
    "repair_oni",
    "upright",
    "write_oni",
]
