"""Rerun's viewer for browsers, served by a process of its own."""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from urllib.parse import quote

from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import ViewerError
from selective_depth.app.viewer.window import PORTS, comes_to_listen, local_url, needed_executable

WEB_PORTS = range(9090, 9100)
"""Where browsers find it; the first is Rerun's own default."""
BIRTH_S = 10.0
"""How long it may take to listen."""


def free_port(host: str, ports: Sequence[int]) -> int:
    """The first of some ports that is free.

    Raises
    ------
    ViewerError
        If all are taken.
    """
    for port in ports:
        with suppress(OSError), socket.create_server((host, port)):
            return port
    raise ViewerError(f"the ports {ports[0]}..{ports[-1]} of {host} are all taken. End one of the programs there.")


def stream_port(host: str) -> int:
    """A free port for the stream that viewers join."""
    return free_port(host, PORTS)


@contextmanager
def serving_web_viewer(host: str, stream: int) -> Iterator[int]:
    """Serve the viewer for browsers while what is inside runs; yields its port.

    The SDK's own `serve_web_viewer` listens to everyone in the network; the program can be told not to.

    Parameters
    ----------
    host : str
        Address to listen at: 127.0.0.1 for browsers of this machine only.
    stream : int
        Port of the stream that it shows.

    Raises
    ------
    ViewerError
        If it does not start.
    """
    port = free_port(host, WEB_PORTS)
    command = [needed_executable(), "--serve-web", "--bind", host, "--web-viewer-port", str(port), local_url(stream)]
    if os.name == "posix":  # it goes when this program does, however that ends: their pipe is closed then
        command = ["sh", "-c", '"$@" & read -r _; kill -9 $!; wait $!', "sh", *command]
    quiet = subprocess.DEVNULL
    with interrupt.started_deaf():
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)
    try:
        address = ("127.0.0.1" if host == "0.0.0.0" else host), port
        if not comes_to_listen(address, BIRTH_S, lambda: process.poll() is None):
            raise ViewerError(f"the viewer for browsers does not start on {host}:{port}.")
        yield port
    finally:
        process.communicate() if os.name == "posix" else process.kill()
        process.wait()


def web_address(host: str, viewer: int, stream: int) -> str:
    """What a browser opens to see a stream, both of which it reaches at a host.

    On this machine the viewer is given the other of the host's two names: a browser takes that for another
    site and gives it a process of its own, so that the page around it is not held up while it paints.
    """
    page = {"127.0.0.1": "localhost", "localhost": "127.0.0.1"}.get(host, host)
    joined = quote(f"rerun+http://{host}:{stream}/proxy", safe="")
    return f"http://{page}:{viewer}/?url={joined}&hide_welcome_screen=1&persist=0&theme=dark"
