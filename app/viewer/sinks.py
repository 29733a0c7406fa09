"""Where a run is seen: file, served stream, remote viewer, window; none may hold it up."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

from selective_depth.app.console.errors import ViewerError
from selective_depth.app.console.output import cannot_write
from selective_depth.app.pipeline import FrameResult, SensorNote, StageTimes
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.handover import Handover
from selective_depth.app.viewer.recording import WRITE_S, Recording, never_wait_at_exit, open_window
from selective_depth.drivers.errors import OutputError

VIEWER_PORT = 9876
PROBE_S = 0.3
"""How long an address is tried. Where no viewer listens the SDK itself would block for 5 s
and lose what is logged."""
WINDOW_S = 10.0
"""How long a window may take to open."""
READY_S = 5.0
"""How long a place may take to open before the run begins without it."""
CHECK_EVERY_S = 1.0
STALL_S = 0.5
"""A viewer that takes longer over a step has stalled; a recording waits no more."""
SPARE_BYTES = 64 << 20
"""Saving ends, with a whole file, when the disk has less room than this."""
CLOSE_S = 1.0
"""How long a place may take over its last frames, and all of them together:"""
CLOSE_ALL_S = 2.5
FILE_QUEUE = 8
"""Steps of a sensor that may wait for a file, while what was written is made sure of."""
INDEXED_FRAMES = 1000
"""Up to so many frames a file gets an index; beyond, its memory would be felt."""


class Place(ABC):
    """One place where steps go. All of it runs in one thread of its own.

    Parameters
    ----------
    name : str
        What messages call it.
    options : ViewerOptions
        What the user asked to see.
    times : StageTimes
        Where the time that logging takes is added, as stage ``log``.

    Attributes
    ----------
    missed : int
        Steps taken while nobody was there to see them.
    """

    def __init__(self, name: str, options: ViewerOptions, times: StageTimes) -> None:
        self.name = name
        self.options = options
        self.missed = 0
        self._times = times
        self._recording: Recording | None = None

    def open(self) -> None:
        """Open the recording, in the thread that will feed it."""
        self._recording = self._connect()

    def put(self, item: FrameResult | SensorNote) -> None:
        """Log a step, or the sensor's state."""
        assert self._recording is not None
        if isinstance(item, SensorNote):
            self._recording.log(item)
            return
        with self._times.stage("log"):
            self._recording.log(item)

    def close(self) -> None:
        """Send what is left and let go."""
        if self._recording is None:
            return
        if self._recording.flush(CLOSE_S):
            self._recording.finish()
        else:
            self._recording.abandon()

    @abstractmethod
    def _connect(self) -> Recording:
        """Open the recording that the steps go to."""


class FilePlace(Place):
    """Saves to an .rrd, and keeps it readable whatever happens to the disk.

    The SDK's writer says nothing when a write fails and never ends after it. So room is
    checked before every step, and once a second what was written is made sure of: after a
    failure the file is cut back to there.
    """

    def __init__(
        self, path: Path, options: ViewerOptions, times: StageTimes, *, index: bool
    ) -> None:
        super().__init__(f"file '{path}'", options, times)
        self.path = path
        self._index = index
        self._sure_bytes = 0
        self._checked_s = time.monotonic()
        try:
            self._held = path.open("ab")  # what is there goes only when the run begins
            free = shutil.disk_usage(path.parent).free
        except OSError as error:
            raise cannot_write(path, error) from None
        if not _lock(self._held):
            raise OutputError(f"another run is writing '{path}'; name another file.")
        if free < 2 * SPARE_BYTES:
            raise OutputError(
                f"'{path}' cannot be written: {free >> 20} MiB are free there, and a run leaves"
                f" {SPARE_BYTES >> 20} MiB of a disk alone. Make room, or name a file elsewhere."
            )

    def put(self, item: FrameResult | SensorNote) -> None:
        """Log a step, if the disk has room for it."""
        free = shutil.disk_usage(self.path.parent).free
        if free < SPARE_BYTES:
            self.close()
            raise OutputError(
                f"the disk is full ({free >> 20} MiB free). '{self.path}' was ended and is whole as"
                " far as it goes; make room and run it again."
            )
        super().put(item)
        if time.monotonic() - self._checked_s > CHECK_EVERY_S:
            self._make_sure()

    def close(self) -> None:
        """Write the rest and the index."""
        if self._recording is not None:
            self._make_sure(CLOSE_S)
            self._recording.finish()
        self._held.close()

    def _connect(self) -> Recording:
        return Recording.to_file(self.path, self.options, index=self._index)

    def _make_sure(self, patience_s: float = WRITE_S) -> None:
        assert self._recording is not None
        if not self._recording.is_written(self.path, patience_s):
            self._recording.abandon()
            os.truncate(self.path, self._sure_bytes)
            raise OutputError(
                f"writing '{self.path}' failed after {self._sure_bytes:,} bytes, which are kept."
                " Check the disk and its quota, and run it again."
            )
        self._sure_bytes = self.path.stat().st_size
        self._checked_s = time.monotonic()


class ServedPlace(Place):
    """Serves a stream that viewers join, on this machine only unless told otherwise."""

    def __init__(self, options: ViewerOptions, times: StageTimes) -> None:
        super().__init__(f"stream served on {options.serve_address}", options, times)
        self.host, self.port = _host_and_port(options.serve_address)
        self.url = f"rerun+http://{options.serve_address}/proxy"
        try:
            with socket.create_server((self.host, self.port)):
                pass
        except OSError as error:
            raise ViewerError(
                f"cannot serve on {options.serve_address}: {error.strerror}. Another program may"
                " have the port; give --serve-address 127.0.0.1:PORT with a free one."
            ) from None

    def _connect(self) -> Recording:
        return Recording.to_server(self.host, self.port, self.options)


class RemotePlace(Place):
    """Sends to a viewer that is open, waits while it stalls, and finds it again if it restarts.

    Each step is sent before the next is taken, so that a stalled viewer costs one step of
    memory, not the half gigabyte that the SDK would queue.
    """

    def __init__(self, url: str, options: ViewerOptions, times: StageTimes, name: str = "") -> None:
        super().__init__(name or f"viewer at {url}", options, times)
        self.url = url
        self._checked_s = 0.0
        parts = urlsplit(url)
        try:
            port = parts.port
        except ValueError as error:
            raise ViewerError(f"'{url}' is no viewer's address: {error}.") from None
        if parts.scheme not in ("rerun", "rerun+http", "rerun+https") or not parts.hostname:
            raise ViewerError(
                f"'{url}' is no viewer's address; write --connect rerun+http://HOST:PORT/proxy."
            )
        self._address = (parts.hostname, port or VIEWER_PORT)
        if not listens(self._address):
            raise ViewerError(
                f"no viewer listens at {url}. Start one there with 'rerun', or leave out --connect."
            )

    def put(self, item: FrameResult | SensorNote) -> None:
        """Log a step and see it off, however long the viewer takes."""
        if self._recording is None and time.monotonic() - self._checked_s > CHECK_EVERY_S:
            self._checked_s = time.monotonic()
            if listens(self._address):
                self.open()  # it is back
        if self._recording is None:
            self.missed += isinstance(item, FrameResult)
            return
        super().put(item)
        if not self._recording.flush():
            self._recording.abandon()
            self._recording = None

    def _connect(self) -> Recording:
        return Recording.to_viewer(self.url, self.options)


class WindowPlace(RemotePlace):
    """Opens a viewer window, or uses the one that is open, which outlives this program."""

    def __init__(self, options: ViewerOptions, times: StageTimes) -> None:
        port = VIEWER_PORT
        if options.serve and _host_and_port(options.serve_address)[1] == VIEWER_PORT:
            port += 1
        address = ("127.0.0.1", port)
        if not listens(address):
            open_window(port, options.viewer_memory)
            deadline_s = time.monotonic() + WINDOW_S
            while not listens(address) and time.monotonic() < deadline_s:
                time.sleep(0.05)
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        super().__init__(url, options, times, name="viewer window")


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def listens(address: tuple[str, int]) -> bool:
    """Whether somebody accepts connections at an address (host, port)."""
    try:
        with socket.create_connection(address, PROBE_S):
            return True
    except OSError:
        return False


def _lock(file: BinaryIO) -> bool:
    """Keep other runs from writing a file, for as long as it is open; False if one does."""
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return True  # a file system without locks
    return True


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or ":" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ViewerError(
            f"'{address}' is no address to serve on; write HOST:PORT, such as 127.0.0.1:9876 (the"
            " server takes no IPv6 address)."
        )
    return host, int(port)


class Viewer:
    """Every place where a run is seen, each fed by a thread of its own.

    Parameters
    ----------
    options : ViewerOptions
        Which places.
    live : bool
        A live source waits for nobody: what a place has no time for is dropped there. A
        recording waits for its file always, and for a viewer that is not stalled.
    times : StageTimes
        Where the time that logging takes is added, as stage ``log``.
    frames : int, optional
        How many frames will come at most; a file of few gets an index.

    Attributes
    ----------
    window : bool
        Whether a window shows the run.

    Raises
    ------
    OutputError, ViewerError
        If a place cannot be written, reached or opened.
    """

    def __init__(
        self,
        options: ViewerOptions,
        *,
        live: bool,
        times: StageTimes,
        frames: int | None = None,
    ) -> None:
        index = frames is not None and frames <= INDEXED_FRAMES
        self.window = not options.headless and has_display()
        self._places: list[Place] = []
        if options.serve:
            self._places.append(ServedPlace(options, times))
        if options.connect is not None:
            self._places.append(RemotePlace(options.connect, options, times))
        if options.save is not None:
            self._places.insert(0, FilePlace(options.save, options, times, index=index))
        if self.window:
            self._places.append(WindowPlace(options, times))
        self._ways: list[Handover[FrameResult | SensorNote]] = []
        for place in self._places:
            file = isinstance(place, FilePlace)
            self._ways.append(
                Handover(
                    place.name,
                    place,
                    lossless=file and not live,
                    patience_s=0.0 if live else STALL_S,
                    capacity=FILE_QUEUE if file and live else 2,
                )
            )

    @property
    def served_url(self) -> str:
        """Address at which viewers join; empty if nothing is served."""
        served = [place.url for place in self._places if isinstance(place, ServedPlace)]
        return served[0] if served else ""

    def wait_ready(self) -> None:
        """Wait until every place is open, though for none that stalls."""
        for way in self._ways:
            way.ready.wait(READY_S)

    def show(self, item: FrameResult | SensorNote) -> None:
        """Hand a step, or the sensor's state without one, to every place.

        Raises
        ------
        Exception
            What ended the file that was asked for; a viewer that is gone is no error.
        """
        for place, way in zip(self._places, self._ways, strict=True):
            way.offer(item)
            if isinstance(place, FilePlace) and way.failure is not None:
                raise way.failure

    @property
    def file_failed(self) -> bool:
        """Whether a file that was asked for ended before its time."""
        pairs = zip(self._places, self._ways, strict=True)
        return any(isinstance(place, FilePlace) and way.failure for place, way in pairs)

    @property
    def dropped(self) -> dict[str, int]:
        """Steps that each place has missed, by its name."""
        pairs = zip(self._places, self._ways, strict=True)
        return {place.name: place.missed + way.dropped for place, way in pairs}

    def close(self) -> list[str]:
        """Finish every place, all of them within 3 s.

        Returns
        -------
        list of str
            What went wrong, a sentence each.
        """
        never_wait_at_exit()
        deadline_s = time.monotonic() + CLOSE_ALL_S
        troubles = []
        for way in self._ways:
            if not way.finish(max(0.1, deadline_s - time.monotonic())):
                troubles.append(f"the {way.name} had stalled and was left behind.")
            elif way.failure is not None:
                troubles.append(f"the {way.name} ended early: {way.failure}")
        return troubles
