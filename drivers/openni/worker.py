"""The process that owns OpenNI2: native code that may crash or hang does it here, alone.

Started by `process.Worker` as a script, so that it needs neither NumPy nor the package and is up
in a fraction of the time. One JSON line on standard input tells what to do, then short commands;
answers are JSON lines on what was its standard output, and depth images go through shared memory.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from primesense import _openni2 as c_api
from primesense import openni2
from primesense.utils import OpenNIError

if TYPE_CHECKING:
    from selective_depth.drivers.openni.link import JobError, Parent, Slots, forbid_core_dumps
else:  # a script finds what lies beside it only if told; last, to stand in nothing's way
    sys.path.append(str(Path(__file__).parent))
    from link import JobError, Parent, Slots, forbid_core_dumps

WAIT_S = 0.2  # longest uninterrupted wait for a frame, and the beat of "idle" messages
SETTLE_S = 0.05  # between stop and close: the runtime's threads set their flags late
MILLIMETRES = int(openni2.PIXEL_FORMAT_DEPTH_1_MM)
DEPTHS = {MILLIMETRES: ("mm", 2), 101: ("0.1 mm", 2)}
COLOURS = {200: ("RGB888", 3), 201: ("YUV422", 2), 205: ("YUYV", 2), 202: ("GRAY8", 1)}
"""Pixel formats that are read, the best first, with their bytes a pixel."""
FORMS = DEPTHS | COLOURS
NOT_FOUND = "SourceNotFoundError"


class Device(openni2.Device):  # type: ignore[misc]
    """A device that survives its own failed opening.

    The library's `__del__` closes a half-built device, which crashes the next opening.
    """

    def _close(self) -> None:
        if getattr(self, "_devinfo", None) is not None:
            super()._close()


def initialize(job: dict[str, Any]) -> None:
    """Load the runtime, once in a process's life.

    As the library's own `initialize` does, but for one file by its full name and with the reason
    kept: what that raises is a list of tuples in a string.
    """
    try:
        with chdir(Path(job["library"]).parent):  # where it looks for what belongs to it
            c_api.load_dll(job["library"])
            c_api.oniInitialize(c_api.ONI_API_VERSION)
    except (OpenNIError, OSError) as error:
        raise JobError(
            f"The OpenNI2 runtime {job['library']} cannot be started: {reason(error)}."
            " Install it again, or set OPENNI2_REDIST to another one's folder.",
            kind="RuntimeMissingError",
        ) from error
    openni2._openni2_initialized = True


def reason(error: Exception) -> str:
    """What the runtime says about a failure, in one line."""
    text = error.args[1] if isinstance(error, OpenNIError) else str(error)
    if isinstance(text, bytes):
        text = text.decode(errors="replace")
    words = " ".join(str(text).split())
    if words:
        return words.rstrip(".")
    code = getattr(error, "code", None)
    return f"OpenNI2 gives no reason (status {int(code) if code is not None else '?'})"


@contextmanager
def refusing(what: str, advice: str = "", remedy: str = "") -> Iterator[None]:
    """End the job where the runtime refuses something; `remedy` as of `JobError`."""
    try:
        yield
    except OpenNIError as error:
        raise JobError(f"{what}: {reason(error)}.{advice}", remedy=remedy) from error


def devices() -> list[dict[str, Any]]:
    """What the runtime's drivers have found."""
    infos = ctypes.POINTER(c_api.OniDeviceInfo)()
    count = ctypes.c_int()
    c_api.oniGetDeviceList(ctypes.byref(infos), ctypes.byref(count))
    found = [
        {name: getattr(info, name).decode(errors="replace") for name in ("uri", "vendor", "name")}
        | {"usb_vendor_id": info.usbVendorId, "usb_product_id": info.usbProductId}
        for info in infos[: count.value]
    ]
    c_api.oniReleaseDeviceList(infos)
    return found


def choose(found: list[dict[str, Any]], wanted: str, like: dict[str, Any] | None) -> list[dict[str, Any]]:
    """Devices that may be the one to open: the one named, the only one, those of a lost one's kind.

    Addresses of one device that differ after a '?' (libfreenect2 has three) count as one.
    """
    named = [device for device in found if device["uri"] == wanted]
    if named and like is None:
        return named
    bases = [device["uri"].partition("?")[0] for device in found]
    found = [device for at, device in enumerate(found) if bases.index(bases[at]) == at]
    if like is not None:
        # Plugged in again, a USB sensor comes back under another address.
        kind = like["vendor"], like["name"]
        others = [d for d in found if (d["vendor"], d["name"]) == kind and d not in named]
        found, wanted = [*named, *others], ""
    uris = ", ".join(device["uri"] for device in found) or "none"
    if wanted:
        raise JobError(f"There is no sensor '{wanted}'. Connected: {uris}.", kind=NOT_FOUND)
    if not found:
        advice = "Plug one in; a Kinect needs its power supply too."
        raise JobError("OpenNI2 finds no depth sensor.", kind=NOT_FOUND, remedy=advice)
    # Of several of a kind a serial number tells the right one; without, only its own address.
    if len(found) > 1 and not (like and (like["serial"] or named)):
        raise JobError(
            f"{len(found)} sensors are connected: {uris}. Name one of them, as in"
            f" `selective-depth live {shlex.quote(found[0]['uri'])}`.",
            kind=NOT_FOUND,
        )
    return found if like and like["serial"] else found[:1]


def mode_key(mode: Any) -> tuple[int, int, int, int]:
    """A video mode to compare; the library's own has no equality."""
    return mode.resolutionX, mode.resolutionY, mode.fps, int(mode.pixelFormat)


def _distance(mode: tuple[int, ...], wanted: tuple[int, ...]) -> tuple[float, ...]:
    """How far a mode is from the wanted one: size, then unit, then rate."""
    sizes = abs(mode[0] * mode[1] - wanted[0] * wanted[1]) + abs(mode[0] - wanted[0])
    return sizes, abs(mode[3] - wanted[3]), abs(mode[2] - wanted[2])


def mode_text(mode: Any) -> str:
    """A video mode for people; the library's own `repr` raises."""
    width, height, fps, pixels = mode_key(mode)
    form, _ = FORMS.get(pixels, (f"pixel format {pixels}", 0))
    return f"{width}x{height} at {fps} fps in {form}"


def set_up(stream: Any, mode: Any) -> None:
    """Take a mode, whole images and no mirroring, but set only what differs: drivers refuse the odd setting."""
    # What a driver does not tell of, or fails to tell, is left as it is.
    with suppress(OpenNIError):
        if stream.is_cropping_supported() and stream.get_cropping().enabled:
            stream.reset_cropping()
    if mode_key(stream.get_video_mode()) != mode_key(mode):
        stream.set_video_mode(mode)
    with suppress(OpenNIError):
        if stream.is_property_supported(c_api.ONI_STREAM_PROPERTY_MIRRORING) and stream.get_mirroring_enabled():
            # Mirroring, where wanted, is the parent's: libfreenect's writes out of bounds.
            stream.set_mirroring_enabled(False)


class Watch(openni2.DeviceListener):  # type: ignore[misc]
    """Sets `lost` when the device goes; nothing else in OpenNI2 tells."""

    def __init__(self, uri: str) -> None:
        super().__init__()
        self._uri = uri.encode()
        self.lost = threading.Event()

    def on_disconnected(self, info: Any) -> None:
        """Called by the runtime, on a thread of its own."""
        if info.uri == self._uri:
            self.lost.set()


class LiveStream:
    """A live device's depth stream, with every setting applied and checked."""

    def __init__(self, job: dict[str, Any], parent: Parent) -> None:
        like, there = job["like"], devices()
        remedy = "Close the program that uses it, or pull it out and plug it in again."
        for info in choose(there, job["uri"], like):
            self.info, self.sensor = info, f"The sensor {info['uri']}"
            parent.send("found")
            self.watch = Watch(info["uri"])
            with refusing(f"{self.sensor} is there but cannot be opened", remedy=remedy):
                self.device = Device(info["uri"].encode())
            info["serial"] = self._serial()
            if not (like and like["serial"]) or info["serial"] == like["serial"]:
                break
            self.device.close()
        else:
            raise JobError(
                f"Of the sensors that are there, none has the serial number {like['serial']}.", kind=NOT_FOUND
            )
        kind = info["vendor"], info["name"]
        same = [each["uri"] for each in there if (each["vendor"], each["name"]) == kind]
        self.twins = len({address.partition("?")[0] for address in same}) > 1
        self.colour: Any = None
        self.colour_trouble = ""
        if not self.device.has_sensor(openni2.SENSOR_DEPTH):
            raise JobError(f"{self.sensor} has no depth camera.")
        with refusing(f"{self.sensor} refuses a depth stream", " Pull it out and plug it in again."):
            self.stream = self.device.create_depth_stream()
            self._configure(job["settings"])
        if job["settings"]["colouring"]["wanted"]:
            self._open_colour()

    def _open_colour(self) -> None:
        """Add the colour stream, where there is one that can be read; depth needs none."""
        depth = mode_key(self.stream.get_video_mode())
        with suppress(OpenNIError):
            if not self.device.has_sensor(openni2.SENSOR_COLOR):
                return
        try:
            modes = list(self.device.get_sensor_info(openni2.SENSOR_COLOR).videoModes)
            order = list(COLOURS)
            known = [mode for mode in modes if mode_key(mode)[3] in order]
            if not known:
                offered = "; ".join(map(mode_text, modes))
                self.colour_trouble = f"its colour is in none of the formats that are read: {offered}"
                return
            mode = min(known, key=lambda m: (_distance(mode_key(m), depth)[0], order.index(mode_key(m)[3]), -m.fps))
            stream = self.device.create_color_stream()
            set_up(stream, mode)
            self._register(True)
            self.colour = stream
        except OpenNIError as error:
            self.colour_trouble = f"its colour stream is refused: {reason(error)}"

    def _serial(self) -> str:
        """Its serial number; empty where the driver does not give it."""
        key = c_api.ONI_DEVICE_PROPERTY_SERIAL_NUMBER
        with suppress(OpenNIError):
            if self.device.is_property_supported(key):
                text = self.device.get_property(key, ctypes.c_char * 128)
                return str(text.value.decode(errors="replace"))
        return ""

    def _configure(self, settings: dict[str, Any]) -> None:
        wanted = (settings["width"], settings["height"], settings["fps"], MILLIMETRES)
        modes = list(self.device.get_sensor_info(openni2.SENSOR_DEPTH).videoModes)
        usable = [mode for mode in modes if mode_key(mode)[3] in DEPTHS]
        mode = min(usable, key=lambda each: _distance(mode_key(each), wanted), default=None)
        if mode is None or not (settings["nearest"] or mode_key(mode)[:3] == wanted[:3]):
            raise JobError(
                f"{self.sensor} cannot give {wanted[0]}x{wanted[1]} at {wanted[2]} fps in mm."
                f" It offers: {'; '.join(map(mode_text, modes))}."
            )
        set_up(self.stream, mode)
        self._register(settings["registration"])
        if settings["registration"] and not self.registered:
            raise JobError(f"{self.sensor} cannot register depth to its colour camera.")

    def _register(self, wanted: bool) -> None:
        """Have depth registered to colour, or not, where the sensor can."""
        device = self.device
        mode = openni2.IMAGE_REGISTRATION_DEPTH_TO_COLOR if wanted else openni2.IMAGE_REGISTRATION_OFF
        known = False
        with suppress(OpenNIError):
            known = device.is_property_supported(
                c_api.ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION
            ) and device.is_image_registration_mode_supported(mode)
            if known and device.get_image_registration_mode() != mode:
                device.set_image_registration_mode(mode)
        self.registered = wanted and known

    def start(self) -> None:
        """Let the frames come."""
        advice = " Check its power supply, pull it out and plug it in again."
        with refusing(f"{self.sensor} does not start", advice):
            self.stream.start()
        try:
            if self.colour is not None:
                self.colour.start()
        except OpenNIError as error:
            self.colour, self.colour_trouble = None, f"its colour stream does not start: {reason(error)}"

    @property
    def streams(self) -> list[Any]:
        """Depth, and colour where there is some."""
        return [self.stream] if self.colour is None else [self.stream, self.colour]

    def close(self) -> None:
        """Release the sensor, in the one order that does not crash."""
        for stream in self.streams:
            stream.stop()
        time.sleep(SETTLE_S)
        for stream in self.streams:
            stream.close()
        self.device.close()
        openni2.unload()


def describe(stream: Any) -> dict[str, Any]:
    """What the parent needs to know of a stream."""
    mode = stream.get_video_mode()
    try:
        fov_rad = stream.get_horizontal_fov(), stream.get_vertical_fov()
    except OpenNIError:
        fov_rad = (0.0, 0.0)  # not every driver knows it
    # Frames in any other format than a depth that is read are misfits.
    form, pixel_bytes = FORMS.get(int(mode.pixelFormat), FORMS[MILLIMETRES])
    return {
        "form": form,
        "pixel_bytes": pixel_bytes,
        "width": mode.resolutionX,
        "height": mode.resolutionY,
        "fps": mode.fps,
        "fov_x_rad": fov_rad[0],
        "fov_y_rad": fov_rad[1],
    }


def misfit(frame: Any, about: dict[str, Any]) -> str:
    """What is wrong with a frame's size or format; empty if nothing. Rows may be padded."""
    width, height, row = about["width"], about["height"], about["width"] * about["pixel_bytes"]
    fits = frame.stride >= row and frame.dataSize >= (height - 1) * frame.stride + row
    if (frame.width, frame.height) != (width, height) or not fits:
        got = (frame.width, frame.height, frame.stride, frame.dataSize)
        return "it is {}x{} (stride {}, {} bytes), expected {}x{} (stride {}, {} bytes)".format(
            *got, width, height, row, row * height
        )
    if FORMS.get(int(frame.videoMode.pixelFormat)) != (about["form"], about["pixel_bytes"]):
        return f"it is {mode_text(frame.videoMode)}, expected {about['form']}"
    return ""


def run_list(parent: Parent) -> None:
    """Say which sensors are there."""
    version = openni2.get_version()
    parent.send(
        "devices", devices=devices(), version=f"{version.major}.{version.minor}.{version.maintenance}.{version.build}"
    )


def run_device(job: dict[str, Any], parent: Parent) -> None:
    """Deliver a live sensor's frames until told to stop."""
    slots = Slots(job, parent)
    live = LiveStream(job, parent)
    live.start()
    about = [describe(stream) for stream in live.streams]
    depth, colour = about[0], about[1] if len(about) > 1 else None
    told = {"colour": colour, "colour_trouble": live.colour_trouble, "registered": live.registered}
    parent.send("opened", device=live.info, twins=live.twins, **depth, **told)
    if not slots.fits(depth["width"] * depth["height"] * depth["pixel_bytes"]):
        raise JobError(f"Frames of {depth['width']}x{depth['height']} pixels are too large.")
    last_depth = time.monotonic()
    while not parent.stop.is_set():
        if live.watch.lost.is_set():
            parent.send("lost")
            break
        stream = openni2.wait_for_any_stream(live.streams, WAIT_S)
        frame = None if stream is None else stream.read_frame()
        filled = frame is not None and frame.dataSize > 0  # a transfer may carry nothing
        now = time.monotonic()
        if filled and stream is live.stream:
            last_depth = now
            deliver(frame, depth, slots, parent, "frame", "misfit")
        else:
            if not filled or now - last_depth > WAIT_S:
                parent.send("idle", silent_s=now - last_depth)
            if filled:
                deliver(frame, colour, slots, parent, "colour", "odd_colour")
        if frame is not None:
            frame.close()
    live.close()


def deliver(frame: Any, about: Any, slots: Slots, parent: Parent, what: str, wrong: str) -> None:
    """Put an image into shared memory and say `what` it is; say it is `wrong` where it does not fit."""
    problem = misfit(frame, about)
    row = about["width"] * about["pixel_bytes"]
    if problem or not slots.fits(row * about["height"]):
        parent.send(wrong, problem=problem or "it is too large")
        return
    slot = slots.take()
    if slot is not None:
        slots.fill(slot, frame.data, row, frame.stride, about["height"])
        parent.send(what, slot=slot, index=frame.frameIndex, timestamp_us=frame.timestamp)


def main() -> None:
    """Do the one job that the parent asks for, then leave without a farewell."""
    # Ctrl-C reaches every process of a terminal; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    forbid_core_dumps()
    parent = Parent()
    job = parent.first_job()
    try:
        initialize(job)
        if job["job"] == "list":
            run_list(parent)
        else:
            run_device(job, parent)
    except JobError as error:
        parent.send("error", error=error.kind, message=str(error), remedy=error.remedy)
    except Exception as error:  # noqa: BLE001 - the parent turns it into a named error
        message = f"OpenNI2 failed: {reason(error)}."
        parent.send("error", error="DeviceLostError", message=message, remedy="")
    # What is needed is closed. The library's own clean-up at exit can crash or hang.
    os._exit(0)


if __name__ == "__main__":
    main()
