"""The viewer window, for real: an X server, the viewer, and the command as a process."""

from __future__ import annotations

import dataclasses
import http.server
import os
import random
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from rerun.experimental import ViewerClient
from rerun_listener import Listener

from selective_depth.app.console.errors import ViewerError
from selective_depth.app.pipeline import StageTimes
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer import Viewer, window
from selective_depth.app.viewer.owner import owner_of

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux") or not shutil.which("Xvfb") or not shutil.which("xwininfo"),
    reason="no Xvfb and xwininfo here (make system-packages)",
)
QUICK = ("--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "60")
SCENE = "virtual:ball?size=160x120&frames={}"
DRIVER_SETTINGS = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES", "LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_FILENAMES")


class Screen:
    """An X server of its own; whatever viewer is on it ends with it."""

    def __init__(self) -> None:
        told, tells = os.pipe()
        # Without Composite a window is opaque, so that a picture of the screen shows it.
        options = ["-screen", "0", "640x480x24", "-nolisten", "tcp", "-extension", "Composite"]
        self._server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(tells), *options], pass_fds=[tells], stderr=subprocess.DEVNULL
        )
        os.close(tells)
        with os.fdopen(told) as lines:
            self.name = f":{lines.readline().strip()}"

    @property
    def viewers(self) -> dict[int, int]:
        """Process ids of the viewers on this screen, by the port that they listen on."""
        found = {}
        for process in Path("/proc").glob("[0-9]*"):
            try:
                environment = (process / "environ").read_bytes().split(b"\0")
                words = (process / "cmdline").read_bytes().decode().split("\0")
            except OSError:
                continue
            if f"DISPLAY={self.name}".encode() in environment and words[0].endswith("rerun"):
                port = int(words[words.index("--port") + 1]) if "--port" in words else 0
                found[port] = int(process.name)
        return found

    @property
    def windows(self) -> int:
        """How many viewer windows the X server has."""
        tree = subprocess.run(
            ["xwininfo", "-root", "-tree", "-display", self.name], capture_output=True, text=True, check=True
        )
        return tree.stdout.count('"Rerun')

    def clear(self) -> None:
        """End all viewers on it."""
        for pid in self.viewers.values():
            os.kill(pid, signal.SIGKILL)
        until(lambda: not self.viewers)

    def end(self) -> None:
        self.clear()
        self._server.kill()
        self._server.wait()


@pytest.fixture(scope="module")
def one_screen() -> Iterator[Screen]:
    made = Screen()
    yield made
    made.end()


@pytest.fixture
def screen(
    one_screen: Screen, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Screen]:
    """A screen without a window, which this process and what it starts has."""
    # The viewer remembers its window's size: the user's own is none of ours.
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path_factory.mktemp("remembered")))
    monkeypatch.setenv("DISPLAY", one_screen.name)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    yield one_screen
    one_screen.clear()


def until(happens: Callable[[], object], patience_s: float = 30.0) -> None:
    """Wait for something; AssertionError if it does not happen.

    A viewer that paints in software may not answer for seconds: then it has not happened yet.
    """
    deadline_s = time.monotonic() + patience_s
    while time.monotonic() < deadline_s:
        with suppress(OSError):
            if happens():
                return
        time.sleep(0.05)
    raise AssertionError("waited in vain")


def start(*arguments: str, cwd: Path, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "selective_depth.app", *arguments, *QUICK],
        cwd=cwd,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(*arguments: str, cwd: Path, **environment: str) -> str:
    """Run a command that must succeed; return what it printed to a pipe that must end."""
    process = start(*arguments, cwd=cwd, **environment)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    return output


@contextmanager
def running(*arguments: str, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """A command that runs until Ctrl-C."""
    process = start(*arguments, cwd=cwd)
    try:
        yield process
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)
        assert process.returncode == 130
    finally:
        process.kill()
        process.wait()


def read_until(process: subprocess.Popen[str], words: str) -> list[str]:
    """What a process says up to a line with these words."""
    assert process.stdout is not None
    lines: list[str] = []
    for line in process.stdout:
        lines.append(line)
        if words in line:
            return lines
    raise AssertionError(f"'{words}' was never said: {lines}")


def frames_in(port: int) -> dict[str, tuple[int | None, int | None]]:
    """First and last frame of each recording that a viewer holds, by its application id."""
    spans = {}
    for each in ViewerClient.connect(window.local_url(port)).get_state().recordings:
        application = each.store_id.split(":")[1]
        frames = [(line.start, line.end) for line in each.timelines if line.name == "frame"]
        spans[application] = frames[0] if frames else (None, None)
    return spans


def quit_viewer(port: int) -> None:
    """Close a window as its own menu does."""
    ViewerClient.connect(window.local_url(port)).run_command("ui.quit")


def test_a_run_opens_a_window_that_shows_every_frame_and_stays(screen: Screen, tmp_path: Path) -> None:
    scene, saved = SCENE.format(13), tmp_path / "run.rrd"
    # The output is a pipe, which would not end before the window if that had inherited it.
    output = run("replay", scene, "--save", str(saved), cwd=tmp_path, RERUN="off")
    assert re.search(r"not shown in viewer window +0 ", output), output
    assert saved.with_suffix(".png").stat().st_size > 10_000
    assert screen.windows == 1
    ((port, viewer),) = screen.viewers.items()
    until(lambda: (0, 12) in frames_in(port).values())
    words = Path(f"/proc/{viewer}/cmdline").read_text().split("\0")
    assert words[words.index("--memory-limit") + 1] == "2GiB"
    assert words[words.index("--server-memory-limit") + 1] == "256MiB"
    assert not window.listens(("127.0.0.2", port)), "it listens for more than this machine"

    # The next run is shown in the same window, with a layout of its own.
    output = run("replay", scene, "--budget", "0.05", "--viewer-memory", "1GiB", cwd=tmp_path)
    assert "keeps the memory it was started with" in output
    assert screen.viewers == {port: viewer}
    until(lambda: list(frames_in(port).values()) == [(0, 12)] * 2)

    # What is served beside it has a port of its own, and stays until Ctrl-C.
    with running("replay", scene, "--realtime", "--serve", cwd=tmp_path) as serving:
        said = read_until(serving, "Ctrl-C ends")
        joining = shlex.split(re.search(r"join with '(.+)'", "".join(said))[1])  # type: ignore[index]
        assert f":{port}/" not in joining[-1]
        free = str(free_port())
        joined = subprocess.Popen([*joining, "--port", free], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: window.listens(("127.0.0.1", int(free))))
        until(lambda: frames_in(int(free)))
        assert screen.windows == 2
        joined.terminate()
        joined.wait()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def test_without_a_window_the_run_goes_on_to_a_file(
    screen: Screen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = SCENE.format(3)
    start_s = time.monotonic()
    output = run("replay", scene, cwd=tmp_path, DISPLAY=":4321")
    assert time.monotonic() - start_s < 20
    (line,) = (line for line in output.splitlines() if "does not start" in line)
    assert "X server" in line
    assert "Saving to out/replay.rrd" in line
    assert {each.suffix for each in (tmp_path / "out").iterdir()} == {".rrd", ".toml", ".png"}

    with monkeypatch.context() as driverless:
        for name in DRIVER_SETTINGS:
            driverless.setenv(name, "/nonexistent")
        asked = ViewerOptions(save=tmp_path / "asked.rrd")
        shown = Viewer(asked, live=False, times=StageTimes(), fallback=tmp_path / "not.rrd")
        assert shown.options == asked
        assert any("The viewer window does not start: " in said for said in shown.news())
        assert list(shown.dropped) == [f"file '{asked.save}'"]
        assert shown.close() == []
    assert not screen.viewers


def test_a_viewer_killed_at_its_birth_is_named(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    def kill() -> None:
        until(lambda: screen.viewers)
        screen.clear()

    killer = threading.Thread(target=kill)
    killer.start()
    start_s = time.monotonic()
    with pytest.raises(ViewerError, match="does not start: it was ended by signal 9"):
        window.get_window(ViewerOptions())
    assert time.monotonic() - start_s < 5
    killer.join()
    monkeypatch.setattr(window, "viewer_executable", lambda: "/nonexistent/rerun")
    with pytest.raises(ViewerError, match="does not start: '/nonexistent/rerun': No such file"):
        window.get_window(ViewerOptions())


@pytest.mark.slow
@pytest.mark.parametrize("listening", [False, True])
def test_a_viewer_that_is_slow_to_open_does_not_hold_up_the_run(
    screen: Screen, tmp_path: Path, listening: bool
) -> None:
    def stop() -> None:
        until(lambda: screen.viewers)
        ((port, pid),) = screen.viewers.items()
        until(lambda: not listening or window.listens(("127.0.0.1", port)))
        os.kill(pid, signal.SIGSTOP)

    stopper = threading.Thread(target=stop)
    stopper.start()
    output = run("replay", SCENE.format(3), cwd=tmp_path)
    stopper.join()
    assert re.search("does not answer within 5 s|has not opened within 5 s", output), output
    assert (tmp_path / "out" / "replay.rrd").stat().st_size > 10_000
    assert bool(screen.viewers) == ("has not opened" in output)


def test_others_on_the_ports_are_left_alone(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    # Ports of its own: on the usual ones others may come and go on this machine meanwhile.
    first = random.randrange(20_000, 30_000)
    second, third = first + 1, first + 2
    monkeypatch.setattr(window, "PORTS", range(first, first + 10))
    page = http.server.ThreadingHTTPServer(("127.0.0.1", first), http.server.BaseHTTPRequestHandler)
    threading.Thread(target=page.serve_forever, daemon=True).start()
    try:
        with Listener(port=second), socket.create_server(("127.0.0.1", third)):
            opened = window.get_window(ViewerOptions())
    finally:
        page.shutdown()
        page.server_close()
    assert not opened.found
    (port,) = screen.viewers
    assert opened.url == window.local_url(port)
    said = "\n".join(opened.notes)
    for taken, whose in (
        (first, "another program"),
        (second, "a Rerun server, or an old viewer"),
        (third, "a program that does not answer"),
    ):
        assert f"Port {taken} has {whose}; the viewer window listens on {port}." in said


def test_two_runs_that_begin_together_share_a_window(screen: Screen) -> None:
    with ThreadPoolExecutor(2) as both:
        opened = list(both.map(window.get_window, [ViewerOptions()] * 2))
    until(lambda: len(screen.viewers) == 1)
    (port,) = screen.viewers
    assert [each.url for each in opened] == [window.local_url(port)] * 2


@pytest.mark.slow
def test_a_window_that_hangs_holds_up_nobody(screen: Screen, tmp_path: Path) -> None:
    window.get_window(ViewerOptions())
    ((_, pid),) = screen.viewers.items()
    os.kill(pid, signal.SIGSTOP)
    start_s = time.monotonic()
    output = run("replay", SCENE.format(60), "--realtime", cwd=tmp_path)
    assert "the viewer window had stalled and was left behind" in output
    assert time.monotonic() - start_s < 25
    assert list(screen.viewers.values()) == [pid]


def test_a_viewer_of_another_version_or_on_another_screen_is_not_taken(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = window.get_window(ViewerOptions())
    assert window.get_window(ViewerOptions()) == dataclasses.replace(first, found=True, notes=())
    (port,) = screen.viewers
    with monkeypatch.context() as other_screen:
        other_screen.setenv("DISPLAY", ":4321")
        assert not owner_of(port).same_screen
        seen = window.look_at(port)
        assert seen is not None
        assert not seen.fits
        assert "on another screen" in seen.name
    monkeypatch.setattr("rerun.__version__", "0.99.0")  # as the viewer of another SDK is seen
    seen = window.look_at(port)
    assert seen is not None
    assert seen.viewer
    assert not seen.fits


def test_a_window_that_closes_is_told_and_one_that_is_closing_is_not_used(screen: Screen, tmp_path: Path) -> None:
    with running("replay", SCENE.format(1_000_000), "--realtime", cwd=tmp_path) as process:
        until(lambda: [port for port in screen.viewers if window.listens(("127.0.0.1", port))])
        (port,) = screen.viewers
        time.sleep(2)
        quit_viewer(port)
        read_until(process, "The viewer window was closed; the run goes on without it.")
    until(lambda: not screen.viewers)

    window.get_window(ViewerOptions())
    ((port, closing),) = screen.viewers.items()
    quit_viewer(port)
    run("replay", SCENE.format(60), "--realtime", cwd=tmp_path)
    until(lambda: closing not in screen.viewers.values())
    (port,) = screen.viewers
    until(lambda: any(end for _, end in frames_in(port).values()))


def test_connecting_opens_no_window(screen: Screen, tmp_path: Path) -> None:
    opened = window.get_window(ViewerOptions())
    run("replay", SCENE.format(5), "--connect", opened.url, cwd=tmp_path)
    (port,) = screen.viewers
    assert list(frames_in(port).values()) == [(0, 4)]
    with Listener() as elsewhere:
        options = dataclasses.replace(elsewhere.options, headless=False)
        shown = Viewer(options, live=False, times=StageTimes())
        assert list(shown.dropped) == [f"viewer at {options.connect}"]
        assert shown.close() == []
    assert screen.windows == 1
    assert list(screen.viewers) == [port]


@pytest.mark.openni
def test_a_sensor_is_seen_in_the_window(screen: Screen, virtual_sensor: object, tmp_path: Path) -> None:
    output = run("live", "--frames", "15", cwd=tmp_path)
    (port,) = screen.viewers
    missed = int(re.search(r"not shown in viewer window +(\d+) ", output)[1])  # type: ignore[index]
    assert missed < 15
    until(lambda: any(end for _, end in frames_in(port).values()))
