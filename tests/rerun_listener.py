"""A Rerun server without a window: what a run can connect to, and what may die under it."""

from __future__ import annotations

import socket
import subprocess
import time

from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer import recording, sinks


class Listener:
    """A Rerun server without a window, to be stopped, killed and started again."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = int(free.getsockname()[1])
        self.process = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        executable = recording.viewer_executable()
        assert executable is not None
        self.process = subprocess.Popen(
            [executable, "--serve-grpc", "--bind", "127.0.0.1", "--port", str(self.port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline_s = time.monotonic() + 10
        while not sinks.listens(("127.0.0.1", self.port)):
            assert time.monotonic() < deadline_s, "the Rerun server did not start"
            time.sleep(0.02)
        return self.process

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def options(self) -> ViewerOptions:
        return ViewerOptions(headless=True, connect=f"rerun+http://127.0.0.1:{self.port}/proxy")
