"""A live sensor through OpenNI2, watched over and brought back when it goes."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from selective_depth.drivers.colour import ON, Colouring
from selective_depth.drivers.errors import (
    DeviceLostError,
    DeviceRefusedError,
    SourceEndedError,
    SourceError,
    SourceNotFoundError,
    SourceTimeoutError,
)
from selective_depth.drivers.frame import Camera, DepthFrame, handed_over
from selective_depth.drivers.oni import upright
from selective_depth.drivers.openni.clock import Count
from selective_depth.drivers.openni.pairing import Pairing
from selective_depth.drivers.openni.process import Message, Worker, camera_of, error_of
from selective_depth.drivers.openni.sensors import DeviceInfo
from selective_depth.drivers.options import Options
from selective_depth.drivers.source import DepthSource

_OPEN_S = 10.0  # a sensor that loads its firmware takes seconds
_REOPEN_S = 4.0  # when it comes back; longer if it took longer the first time
_FIRST_FRAME_S = 10.0  # silence that a sensor is allowed before its first frame
_STALL_S = 1.0  # silence after which the sensor counts as stalled
_RESTART_S = 3.0  # silence after which it is opened afresh
_HANG_S = 2.0  # the worker says something every 0.2 s; beyond this it hangs
_MISFITS = 15  # so many wrong frames in a row, and the sensor is set up afresh
_BACK_OFF_S = (0.2, 0.4, 0.8, 1.5)  # pauses between attempts, the last one for ever
_NO_FRAMES = (
    " Plug it into a port of its own, not a hub, away from other cameras (a bus has room for one);"
    " check its power supply; in a virtual machine, pass the whole USB controller through."
)
_GRACE_S = 1.0  # for a worker to stop the sensor before it is killed
_PAIR_S = 0.01  # how soon a frame that waits for its colour is handed on without
_BEAT_S = 0.1  # how soon the supervisor notices that it should end


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """How a live sensor is set up, and set up again whenever it comes back.

    Parameters
    ----------
    width, height : int, default 640, 480
        Size of its depth image, in pixels.
    fps : int, default 30
        Its frame rate.
    mirror : bool, default False
        Deliver the image as in a mirror.
    nearest : bool, default False
        Where it has no such mode, take the one that is nearest to it.
    registration : bool, default False
        Depth registered to the sensor's colour camera, or refused; where there is colour it is
        registered in any case if it can be.
    intrinsics : (float, float, float, float), optional
        fx, fy, cx, cy in pixels; default from the field of view that the driver states.
    colouring : Colouring, optional
        What is known of its colour; default what the driver states.
    """

    width: int = 640
    height: int = 480
    fps: int = 30
    mirror: bool = False
    nearest: bool = False
    registration: bool = False
    intrinsics: tuple[float, ...] | None = None
    colouring: Colouring = ON


def parse_address(text: str) -> tuple[str, DeviceSettings]:
    """What a sensor's name with options says, ``ADDRESS?mode=640x480@30``: its address and settings.

    Raises
    ------
    SourceNotFoundError
        If an option is unknown or wrong.
    """
    # An address may have a '?' of its own.
    address, query = [*re.split(r"\?(?=(?:mode|camera|scale|topic|stream|colour)=)", text, maxsplit=1), ""][:2]
    options = Options(query, f"the sensor '{address}'")
    mode = options.numbers("mode", "WIDTHxHEIGHT@FPS", 1, 1e5, r"x|@")
    width, height, fps = map(int, mode or (640, 480, 30))
    intrinsics, colouring = options.camera(), Colouring.of(options)
    settings = DeviceSettings(width, height, fps, nearest=mode is None, intrinsics=intrinsics, colouring=colouring)
    options.done()
    return address, settings


class OpenNIDevice(DepthSource):
    """A live depth sensor: the newest frame wins.

    A supervisor thread takes the frames in and notices what OpenNI2 does not report. It opens
    the sensor again with the same settings, for as long as it takes, with pauses that grow to
    1.5 s; `state` tells how it stands, and `read` raises a named error meanwhile.

    ======================  =======================================================
    no frame for 1 s        ``"stalled"``; after 3 s it is opened afresh
    unplugged               ``"lost"`` until there is a sensor of its kind again
    driver crashes          ``"reconnecting"``
    driver hangs for 2 s    ``"reconnecting"``; its process is killed
    frames of a wrong size  thrown away; after 15 in a row ``"reconnecting"``
    ======================  =======================================================

    Parameters
    ----------
    device_uri : str, default ""
        Which sensor; empty for the only one.
    settings : DeviceSettings, optional
        Default 640x480 at 30 fps, not mirrored, not registered.
    tap : callable, optional
        Its `tap` from the first frame on.

    Attributes
    ----------
    device : DeviceInfo
        The sensor that was opened.
    state : str
        ``"live"``, ``"stalled"``, ``"lost"`` or ``"reconnecting"``.
    state_reason : str
        Why, in a few words; empty while live.
    restarts : int
        How often the sensor has been brought back.
    misfits : int
        Frames of the wrong size or format that were thrown away.

    Raises
    ------
    RuntimeMissingError
        If OpenNI2 is not installed.
    SourceNotFoundError
        If there is no such sensor, or there are several and none is named.
    DeviceRefusedError
        If it is there but busy, not permitted, without the wanted mode, or does not start.
    """

    live = True
    restarts = misfits = 0
    state_reason = ""
    device: DeviceInfo

    def __init__(
        self,
        device_uri: str = "",
        settings: DeviceSettings | None = None,
        *,
        tap: Callable[[DepthFrame], None] | None = None,
    ) -> None:
        self.uri = f"openni:{device_uri}" if device_uri else "openni"
        self.settings = settings or DeviceSettings(nearest=True)
        self._wanted_uri = device_uri
        self.tap = tap
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._newest: DepthFrame | None = None
        self._failure: BaseException | None = None
        self._first: int | None = None
        self._first_number = 0
        self._next_number: int | None = None
        self._count = Count()
        self._attempts = 0
        started = time.monotonic()
        about = self._open(_OPEN_S, None)
        self._reopen_s = max(_REOPEN_S, 2 * (time.monotonic() - started))
        camera, notes = camera_of(about, self.settings.intrinsics)
        if self.settings.mirror:
            camera = replace(camera, cx=camera.width - 1 - camera.cx)
        self.camera = camera
        self.fps = float(about["fps"])
        self._tenths = about["form"] == "0.1 mm"
        colouring = self.settings.colouring
        if self._colour is not None:
            with suppress(ValueError):
                seen = Camera.from_fov(*(self._colour[key] for key in ("width", "height", "fov_x_rad", "fov_y_rad")))
                colouring = colouring.told_by(seen.intrinsics)
        self._pairing = Pairing(self._colour is not None, bool(about["registered"]), colouring)
        wanted = (self.settings.width, self.settings.height, self.settings.fps)
        taken = (camera.width, camera.height, int(about["fps"]))
        if taken != wanted:
            text = "it does not offer {}x{}@{}; {}x{}@{} is used instead, --mode chooses another"
            notes += (text.format(*wanted, *taken),)
        for note in (*notes, about["colour_trouble"]):
            self._note_once(note)
        self._supervisor = threading.Thread(target=self._supervise, name="openni-supervisor", daemon=True)
        self._supervisor.start()

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the newest frame that has not been read, waiting for one if need be.

        Parameters
        ----------
        timeout_s : float, default 5.0
            How long to wait at most.

        Raises
        ------
        SourceTimeoutError
            If the sensor is there but gave nothing in time.
        DeviceLostError
            If it is not there. It is still looked for: read again to wait on.
        SourceEndedError
            If the source has been closed.
        """
        self.check_process()
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self._failure or self._closing.is_set(), timeout_s)
            if self._closing.is_set():
                raise SourceEndedError(f"{self.uri} has been closed.")
            if self._failure is not None:
                raise self._failure
            if self._newest is None:
                raise self._absence(timeout_s)
            frame, self._newest = self._newest, None
        number = frame.index
        if self._next_number is None:
            self._first_number = self._next_number = number
        self.dropped += number - self._next_number
        self._next_number = number + 1
        return replace(frame, index=number - self._first_number)

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame comes, but no longer than this, and take none."""
        with self._changed:
            self._changed.wait(timeout_s)

    def close(self) -> None:
        """Stop the sensor and release it. Harmless when called twice."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        self._supervisor.join()

    def _absence(self, timeout_s: float) -> SourceError:
        """The error for a frame that did not come."""
        if self.state in ("lost", "reconnecting"):
            return DeviceLostError(
                f"The sensor {self.uri} is {self.state}: {self.state_reason}. It is opened again"
                " as soon as it is there."
            )
        advice = " Check its cable and its power supply." if self.state == "stalled" else ""
        return SourceTimeoutError(f"The sensor {self.uri} gave no frame within {timeout_s:g} s.{advice}")

    def _become(self, state: str, why: str = "") -> None:
        with self._changed:
            self.state, self.state_reason = state, why

    def _open(self, timeout_s: float, known: DeviceInfo | None) -> Message:
        """Start a worker on the sensor and wait until it streams; what it then says of itself.

        A sensor that is known may have come back under another address.
        """
        worker = Worker(
            "device", uri=self._wanted_uri, like=asdict(known) if known else None, settings=asdict(self.settings)
        )
        try:
            deadline = time.monotonic() + timeout_s
            while not self._closing.is_set():
                message = worker.receive(min(deadline - time.monotonic(), _BEAT_S))
                if message is None:
                    if time.monotonic() > deadline:
                        raise DeviceRefusedError(
                            f"The sensor {self.uri} does not open: OpenNI2 hangs for"
                            f" {timeout_s:g} s. Pull it out and plug it in again."
                        )
                elif message["kind"] == "found":
                    if self.state == "lost":
                        self._become("reconnecting", "it is there again")
                elif message["kind"] == "opened":
                    self.device = DeviceInfo(**message["device"])
                    self._worker = worker
                    self._colour: Message | None = message["colour"]
                    if message["twins"] and not self.device.serial:
                        self._note_once(
                            "there are several of its kind and its driver gives no serial number; once one is"
                            " plugged in again, it cannot be known which it is"
                        )
                    return message
                elif message["kind"] == "error":
                    raise error_of(message)
                elif message["kind"] == "died":
                    raise DeviceRefusedError(f"The sensor {self.uri} does not open: {message['reason']}.")
            raise SourceEndedError(f"{self.uri} has been closed.")
        except BaseException:
            worker.close()
            raise

    def _supervise(self) -> None:
        try:
            while not self._closing.is_set():
                state, why = self._follow()
                self._become(state, why)
                self._worker.close(_GRACE_S)
                self._reopen()
        except BaseException as error:  # noqa: BLE001 - a reader must hear of it, whatever it is
            with self._changed:
                self._failure = error
                self._changed.notify_all()
        finally:
            self._worker.close()

    def _follow(self) -> tuple[str, str]:
        """Take frames in until something is wrong; return the new state and the reason."""
        misfits = unheard = 0
        silence_s = _FIRST_FRAME_S
        while not self._closing.is_set():
            message = self._worker.receive(_PAIR_S if self._pairing.waits else _BEAT_S)
            # Beats, not the clock: if this process was held up, it is not the worker's fault.
            unheard = unheard + 1 if message is None and not self._pairing.waits else 0
            if message is None:
                self._hand_on(self._pairing.late())
                if unheard * _BEAT_S > _HANG_S:
                    self._worker.close()  # at once: it would not stop the sensor any more
                    return "reconnecting", "OpenNI2 hangs"
                continue
            match message["kind"]:
                case "frame":
                    misfits, silence_s = 0, _RESTART_S
                    self._arrive(message)
                case "colour":
                    self._colour_arrives(message)
                case "odd_colour":
                    self._note_once(f"its colour is left out: {message['problem']}")
                case "misfit":
                    misfits += 1
                    self.misfits += 1
                    if misfits >= _MISFITS:
                        return "reconnecting", f"{misfits} wrong frames in a row; the last: {message['problem']}"
                case "idle" if message["silent_s"] > silence_s:
                    if self._first is None:
                        raise DeviceRefusedError(
                            f"The sensor {self.uri} opens, but sent no frame for {silence_s:g} s." + _NO_FRAMES
                        )
                    return "reconnecting", f"no frame for {silence_s:g} s"
                case "idle" if message["silent_s"] > _STALL_S:
                    self._become("stalled", "it sends no frames")
                case "lost":
                    return "lost", "it was unplugged or lost its power"
                case "died":
                    return "reconnecting", message["reason"]
                case "error":
                    return "reconnecting", message["message"].rstrip(".")
        return "lost", "closed"

    def _arrive(self, message: Message) -> None:
        stored = self._worker.take(message, self.camera.width, self.camera.height)
        depth_mm = handed_over(upright(stored, self._tenths, self.settings.mirror))
        number, timestamp_us = self._count.follow(message)
        if self._count.mended:
            self._note_once(
                "its clock stands, jumps back or does not count microseconds; this computer's tells the times instead"
            )
        frame = DepthFrame(depth_mm, number, timestamp_us, self.camera, self.uri)
        self._attempts = 0
        self._hand_on(self._pairing.depth(frame, int(message["timestamp_us"])))

    def _colour_arrives(self, message: Message) -> None:
        assert self._colour is not None
        colour = self._worker.take_colour(message, self._colour)
        if colour is not None:
            colour = colour[:, ::-1] if self.settings.mirror else colour
            self._hand_on(self._pairing.colour(colour, int(message["timestamp_us"])))

    def _hand_on(self, frames: list[DepthFrame]) -> None:
        """Frames that are complete go to whoever waits for one."""
        for frame in frames:
            self._note_once(self._pairing.trouble)
            if self._first is None:
                self._first = frame.index
            frame = replace(frame, index=frame.index - self._first)
            if (tap := self.tap) is not None:
                tap(frame)
            with self._changed:
                self.state, self.state_reason = "live", ""
                self._newest = frame
                self._changed.notify_all()

    def _note_once(self, sentence: str) -> None:
        """Say it, unless it is empty or was said before."""
        note = f"{self.uri}: {sentence}."
        if sentence and note not in self.notes:
            self.notes += (note,)

    def _reopen(self) -> None:
        """Open the sensor again, trying for as long as it takes."""
        while not self._closing.wait(_BACK_OFF_S[min(self._attempts, len(_BACK_OFF_S) - 1)]):
            self._attempts += 1
            try:
                self._open(self._reopen_s, self.device)
            except SourceNotFoundError as error:
                self._become("lost", str(error).rstrip("."))
            except SourceError as error:
                self._become("reconnecting", str(error).rstrip("."))
            else:
                self.restarts += 1
                self._count.restart()
                self._pairing.restart()
                return
