"""Sinks, where a run is seen: file, served stream, remote viewer, window; none may hold it up."""

from __future__ import annotations

import os
import shutil
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Container
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from selective_depth.app.console.errors import ViewerError
from selective_depth.app.console.output import cannot_write, lock
from selective_depth.app.pipeline import FrameResult, SensorNote, StageTimes
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.stream import WRITE_S, Recording
from selective_depth.app.viewer.window import PORTS, ask, comes_to_listen, get_window, listens, local_url, look_at
from selective_depth.drivers.errors import OutputError

CHECK_EVERY_S = 1.0
SPARE_BYTES = 64 << 20
"""Saving ends, with a whole file, when the disk has less room than this."""
CLOSE_S = 1.0
"""How long a sink may take over its last frames."""
SETTLE_S = 0.5
CLOSING_S = 4.0
"""A window that is being closed answers for up to 1.7 s more, and lives for 2.9 s, on a busy
machine: one that was found is asked again after the first time, and counts as not found at all
if it goes within the second."""
SERVE_S = 2.0
"""How long a server may take to listen."""


Item = FrameResult | SensorNote
"""What is shown: a frame's result, or the sensor's state while there is no frame."""


@dataclass(frozen=True)
class Showing:
    """What all sinks of a run have in common.

    Attributes
    ----------
    options : ViewerOptions
        What the user asked to see.
    times : StageTimes
        Where the time that logging takes is added, as stage ``log``.
    tell : callable
        Takes a sentence that the user should hear at once.
    application : str
        Application id: recordings of the same one share their layout in a viewer.
    """

    options: ViewerOptions
    times: StageTimes
    tell: Callable[[str], None]
    application: str


class Sink(ABC):
    """Where the results of frames go. Once it is made, all of it runs in one thread of its own.

    Parameters
    ----------
    name : str
        What messages call it.
    showing : Showing
        What all sinks of the run have in common.

    Attributes
    ----------
    missed : int
        Results taken while nobody was there to see them.
    """

    def __init__(self, name: str, showing: Showing) -> None:
        self.name = name
        self.showing = showing
        self.missed = 0
        self._recording: Recording | None = None

    def open(self) -> None:
        """Open the recording, in the thread that will feed it; may take its time."""
        self._recording = self._connect()

    def put(self, item: Item) -> None:
        """Log a frame's result, or the sensor's state; may block for as long as it likes."""
        assert self._recording is not None
        if isinstance(item, SensorNote):
            self._recording.logger.log_state(item.state)
            return
        with self.showing.times.stage("log"):
            self._recording.logger.log(item)

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
        """Open the recording that the results go to."""


class FileSink(Sink):
    """Saves to an .rrd, and keeps it readable whatever happens to the disk.

    The SDK's writer says nothing when a write fails and never ends after it. So room is
    checked before every result, and once a second what was written is made sure of: after a
    failure the file is cut back to there.
    """

    def __init__(self, path: Path, showing: Showing, *, index: bool) -> None:
        super().__init__(f"file '{path}'", showing)
        self.path = path
        self._index = index
        self._sure_bytes = 0
        self._checked_s = time.monotonic()
        self._new = not path.exists()
        try:
            self._held = path.open("ab")  # what is there goes only when the run begins
            free = shutil.disk_usage(path.parent).free
        except OSError as error:
            raise cannot_write(path, error) from None
        if not lock(self._held):
            raise OutputError(f"another run is writing '{path}'; name another file.")
        if free < 2 * SPARE_BYTES:
            self.discard()
            raise OutputError(
                f"'{path}' cannot be written: {free >> 20} MiB are free there, and a run keeps"
                f" {SPARE_BYTES >> 20} MiB of a disk free. Make room, or name a file elsewhere."
            )

    def put(self, item: Item) -> None:
        """Log a result, if the disk has room for it."""
        free = shutil.disk_usage(self.path.parent).free
        if free < SPARE_BYTES:
            self.close()
            raise OutputError(
                f"the disk is full ({free >> 20} MiB free). '{self.path}' was closed early and can be"
                " opened as far as it goes; make room and run it again."
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

    def discard(self) -> None:
        """Let go of it before it was opened, and leave no empty file behind."""
        self._held.close()
        if self._new:
            self.path.unlink(missing_ok=True)

    def _connect(self) -> Recording:
        return Recording.to_file(self.path, self.showing.application, self.showing.options, index=self._index)

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


class ServedSink(Sink):
    """Serves a stream that viewers join, on this machine only unless told otherwise."""

    def __init__(self, showing: Showing) -> None:
        self.host, self.port = _address_to_serve(showing.options.serve_address)
        super().__init__(f"stream served on {self.host}:{self.port}", showing)
        host = own_address() if self.host == "0.0.0.0" else self.host
        self.url = f"rerun+http://{host}:{self.port}/proxy"

    def _connect(self) -> Recording:
        options = self.showing.options
        origins = [options.serve_origin] if options.serve_origin else None
        try:
            target = rr.GrpcServerSink(
                self.host, self.port, server_memory_limit=options.serve_memory, cors_allow_origin=origins
            )
            recording = Recording(target, self.showing.application, options)
        except RuntimeError as error:
            raise ViewerError(f"cannot serve on {self.host}:{self.port}: {error}.") from None
        if not comes_to_listen((self.host, self.port), SERVE_S):
            raise ViewerError(
                f"cannot serve on {self.host}:{self.port}: the server does not listen within"
                f" {SERVE_S:g} s. Give another --serve-address."
            )
        return recording


class RemoteSink(Sink):
    """Sends to a viewer that is open, waits while it stalls, and finds it again if it restarts.

    Each result is sent before the next is taken, so that a stalled viewer costs one result of
    memory, not the half gigabyte that the SDK would queue.
    """

    def __init__(self, url: str, showing: Showing, name: str = "") -> None:
        super().__init__(name or f"viewer at {url}", showing)
        self.url = url
        self._checked_s = 0.0
        self._address = _host_and_port(url)
        self._meet()

    def put(self, item: Item) -> None:
        """Log a result and wait until it is sent, however long the viewer takes."""
        if self._recording is None and time.monotonic() - self._checked_s > CHECK_EVERY_S:
            self._checked_s = time.monotonic()
            if self._is_back():
                self._recording = self._connect()
        if self._recording is None:
            self.missed += isinstance(item, FrameResult)
            return
        super().put(item)
        if not self._recording.flush():
            self._recording.abandon()
            self._recording = None
            self._lose(item)

    def close(self) -> None:
        """Send what is left and let go; say so if the viewer has gone meanwhile."""
        super().close()
        if self._recording is not None and not listens(self._address):
            self._tell_of_loss()

    def _meet(self) -> None:
        """See that a viewer listens, and which."""
        listener = ask(self.url) if listens(self._address) else None
        if listener is None:
            raise ViewerError(f"no viewer listens at {self.url}. Start one there with 'rerun', or leave out --connect.")
        if not listener.rerun:
            raise ViewerError(f"what listens at {self.url} is {listener.name}, not a Rerun viewer.")
        if not listener.fits:
            self.showing.tell(
                f"What listens at {self.url} is {listener.name}; views may stay empty in any other"
                f" viewer than Rerun {rr.__version__}."
            )

    def _is_back(self) -> bool:
        return listens(self._address)

    def _lose(self, item: Item) -> None:
        """The viewer has gone while it was sent something."""
        self.missed += isinstance(item, FrameResult)
        self._tell_of_loss()

    def _tell_of_loss(self) -> None:
        self.showing.tell(f"The {self.name} was closed; the run goes on without it.")

    def _connect(self) -> Recording:
        return Recording(rr.GrpcSink(self.url), self.showing.application, self.showing.options)


class WindowSink(RemoteSink):
    """Opens a viewer window, or uses the one that is open, which outlives this program.

    Attributes
    ----------
    window : Window
        The one that is used.
    """

    def __init__(self, showing: Showing, taken: Container[int]) -> None:
        self._taken = taken
        super().__init__(local_url(PORTS[0]), showing, "viewer window")

    def open(self) -> None:
        """Open the recording; in another window if the one that was found is just closing."""
        if self.window.found:
            time.sleep(SETTLE_S)
            if not self._is_back():
                self._meet()
        super().open()

    def put(self, item: Item) -> None:
        """Log a result and wait until it is sent, however long the viewer takes."""
        self._sent += isinstance(item, FrameResult)
        super().put(item)

    def _meet(self) -> None:
        self.window = get_window(self.showing.options, self._taken)
        self._since_s, self._sent = time.monotonic(), 0
        self.url = self.window.url
        self._address = _host_and_port(self.url)
        for note in self.window.notes:
            self.showing.tell(note)

    def _is_back(self) -> bool:
        listener = look_at(self._address[1])
        return listener is not None and listener.fits

    def _lose(self, item: Item) -> None:
        if not self.window.found or time.monotonic() - self._since_s > CLOSING_S:
            super()._lose(item)
            return
        self.showing.tell("The viewer window that was open was just closing; another is opened.")
        self.missed += self._sent - isinstance(item, FrameResult)
        self._meet()
        super().open()
        self.put(item)


def _host_and_port(url: str) -> tuple[str, int]:
    """Where a viewer listens, of its address."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise ViewerError(f"'{url}' is not a viewer's address: {error}.") from None
    if parts.scheme not in ("rerun", "rerun+http", "rerun+https") or not parts.hostname:
        raise ViewerError(f"'{url}' is not a viewer's address; write --connect rerun+http://HOST:PORT/proxy.")
    return parts.hostname, port or PORTS[0]


def _address_to_serve(address: str | None) -> tuple[str, int]:
    """A free address to serve on (IPv4, port): the one that was asked for, or on this machine."""
    if address is None:
        addresses = [("127.0.0.1", port) for port in PORTS]
    else:
        host, _, port = address.rpartition(":")
        if not host or ":" in host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ViewerError(
                f"'{address}' is not an address to serve on; write HOST:PORT, such as 127.0.0.1:9876"
                " (the server takes no IPv6 address)."
            )
        addresses = [(host, int(port))]
    for host, number in addresses:
        try:
            found = socket.getaddrinfo(host, number, socket.AF_INET, socket.SOCK_STREAM)
            resolved = str(found[0][4][0])
            with socket.create_server((resolved, number)):
                return resolved, number
        except OSError as error:
            reason = error.strerror
    raise ViewerError(
        f"cannot serve on {address or f'the ports {PORTS[0]}..{PORTS[-1]}'}: {reason}. Another"
        " program may have the port; give --serve-address 127.0.0.1:PORT with a free one."
    )


def own_address() -> str:
    """This machine's address in its network, as others can reach it; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way_out:
        try:
            way_out.connect(("192.0.2.1", 9))  # an address kept for documentation
            return str(way_out.getsockname()[0])
        except OSError:
            return socket.gethostname()  # no network
