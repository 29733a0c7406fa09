"""Depth through OpenNI2: live sensors, and recording them.

OpenNI2 itself runs in a process of its own (`worker`): what crashes or hangs there
becomes a named error here, and frames already delivered stay good.
"""

from selective_depth.drivers.openni.device import DeviceSettings, OpenNIDevice, parse_address
from selective_depth.drivers.openni.recorder import RecordingReport, record
from selective_depth.drivers.openni.runtime import find_runtime
from selective_depth.drivers.openni.sensors import DeviceInfo, list_devices, runtime_version, survey
from selective_depth.drivers.openni.usb import usb_advice

__all__ = [
    "DeviceInfo",
    "DeviceSettings",
    "OpenNIDevice",
    "RecordingReport",
    "find_runtime",
    "list_devices",
    "parse_address",
    "record",
    "runtime_version",
    "survey",
    "usb_advice",
]
