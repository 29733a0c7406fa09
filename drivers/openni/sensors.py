"""Which sensors OpenNI2 sees."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

from selective_depth.drivers.errors import RuntimeMissingError
from selective_depth.drivers.openni.process import Worker, error_of

_LIST_S = 8.0  # drivers search the USB bus when they are loaded


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A sensor as OpenNI2 lists it.

    Parameters
    ----------
    uri : str
        Its address, for ``openni:<uri>``.
    vendor, name : str
        What its driver calls it.
    usb_vendor_id, usb_product_id : int
        Its numbers on the USB bus; 0 where there is no bus.
    serial : str
        Its serial number, known once it is open; empty where the driver gives none.
    """

    uri: str
    vendor: str
    name: str
    usb_vendor_id: int
    usb_product_id: int
    serial: str = ""


def list_devices() -> list[DeviceInfo]:
    """The sensors that OpenNI2's drivers find now; an empty list if there is none.

    Raises
    ------
    RuntimeMissingError
        If OpenNI2 is not installed or does not start.
    """
    return survey()[0]


def survey() -> tuple[list[DeviceInfo], str]:
    """As `list_devices`, with the version of the runtime; asked at once, none of them is opened."""
    with closing(Worker("list")) as worker:
        answer = worker.receive(_LIST_S)
    if answer is not None and answer["kind"] == "error":
        raise error_of(answer)
    if answer is None or answer["kind"] != "devices":
        happened = "it did not answer" if answer is None else answer["reason"]
        raise RuntimeMissingError(
            f"OpenNI2 could not list its sensors: {happened}. One of its drivers may be broken:"
            " look at the folder OpenNI2/Drivers beside the runtime."
        )
    return [DeviceInfo(**device) for device in answer["devices"]], str(answer["version"])


def runtime_version() -> str:
    """The version of the installed OpenNI2 runtime, such as ``2.2.0.33``.

    Raises
    ------
    RuntimeMissingError
        If OpenNI2 is not installed or does not start.
    """
    return survey()[1]
