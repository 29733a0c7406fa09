"""A Rerun server without a window: what a run can connect to, and what may die under it."""

from __future__ import annotations

import socket
import subprocess
import time
from typing import Self

from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer import window


class Listener:
    """A Rerun server without a window, to be stopped, killed and started again.

    Parameters
    ----------
    follow : str, default ""
        A served stream that it takes in, as a viewer that joins would.
    port : int, default 0
        Where it listens; by default at a free port.
    """

    def __init__(self, follow: str = "", port: int = 0) -> None:
        with socket.create_server(("127.0.0.1", port)) as free:
            self.port = int(free.getsockname()[1])
        self._follow = [follow] if follow else []
        self.process = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        executable = window.viewer_executable()
        assert executable is not None
        serve = ["--serve-grpc", "--bind", "127.0.0.1", "--port", str(self.port)]
        self.process = subprocess.Popen(
            [executable, *self._follow, *serve], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline_s = time.monotonic() + 10
        while not window.listens(("127.0.0.1", self.port)):
            assert time.monotonic() < deadline_s, "the Rerun server did not start"
            time.sleep(0.02)
        return self.process

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.kill()

    @property
    def options(self) -> ViewerOptions:
        return ViewerOptions(headless=True, connect=f"rerun+http://127.0.0.1:{self.port}/proxy")
