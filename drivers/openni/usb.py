"""What the USB bus says of a sensor that OpenNI2 does not find or open."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

_KINECT_MOTORS = {(0x045E, 0x02B0), (0x045E, 0x02C2)}
_PRIMESENSE = {(0x1D27, product) for product in (0x0600, 0x0601, 0x0609)}  # as built into the ASUS Xtion, too
_ORBBEC = 0x2BC5  # of whose sensors there are dozens
_LIBFREENECT = "FreenectDriver", "build libfreenect's, as the README says"
_SENSORS = (
    ("A Kinect for Xbox 360", {(0x045E, 0x02AE)}, *_LIBFREENECT),
    ("A Kinect for Windows", {(0x045E, 0x02BF)}, *_LIBFREENECT),
    ("A Kinect for Xbox One", {(0x045E, 0x02C4), (0x045E, 0x02D8)}, "freenect2", "build libfreenect2's"),
    ("A PrimeSense sensor", _PRIMESENSE, "PS1080", "install the runtime again"),
    ("An Orbbec sensor", {(_ORBBEC, 0)}, "orbbec", "copy liborbbec.so of Orbbec's OpenNI2 SDK beside the others"),
)
"""Sensors, their numbers on the bus, OpenNI2's driver for them, and where it comes from."""


def usb_advice(
    drivers: Collection[str], bus: Path = Path("/sys/bus/usb/devices"), nodes: Path = Path("/dev/bus/usb")
) -> str:
    """What to do about a sensor that is plugged in but not found, or not opened.

    Parameters
    ----------
    drivers : collection of str
        The drivers of the OpenNI2 runtime.
    bus, nodes : Path, optional
        Where Linux describes its USB devices, and where they are opened.

    Returns
    -------
    str
        One or two sentences; empty where the bus tells nothing (as on other systems).
    """
    found = _devices(bus, nodes)
    for name, numbers, driver, remedy in _SENSORS:
        opened_by = [found[number] for number in numbers & found.keys()]
        if not opened_by:
            continue
        if not any(driver.lower() in one.lower() for one in drivers):
            having = ", ".join(sorted(drivers)) or "none"
            return f"{name} is on the USB bus, but OpenNI2 has no driver for it (it has: {having}): {remedy}."
        for node in opened_by:
            if not os.access(node, os.R_OK | os.W_OK):
                return (
                    f"{name} is on the USB bus, but you may not use it ({node}): install"
                    " the udev rules of libopenni2-0 or libfreenect, then plug it in again."
                )
        return f"{name} is on the USB bus: close the program that uses it, or plug it in again."
    if _KINECT_MOTORS & found.keys():
        return "A Kinect's motor is on the USB bus but not its camera: plug in its power supply."
    return ""


def _devices(bus: Path, nodes: Path) -> dict[tuple[int, int], Path]:
    """Vendor and product number of every USB device, and the node that opens it."""
    found = {}
    for device in bus.glob("*"):
        try:
            vendor, product = (int((device / name).read_text(), 16) for name in ("idVendor", "idProduct"))
            place = [int((device / name).read_text()) for name in ("busnum", "devnum")]
        except (OSError, ValueError):
            continue  # an interface, or it was pulled out just now
        found[vendor, product if vendor != _ORBBEC else 0] = nodes / f"{place[0]:03}" / f"{place[1]:03}"
    return found
