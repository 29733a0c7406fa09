"""The viewer: what is logged reads back exactly, and nobody ever waits for a dead one."""

from __future__ import annotations

import dataclasses
import http.server
import itertools
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun_listener import Listener
from steps import HEADLESS, HEIGHT, WIDTH, images_of, make_step, rows_of, save

from selective_depth.app import cli
from selective_depth.app.console.errors import UsageError, ViewerError
from selective_depth.app.pictures import palette
from selective_depth.app.pipeline import FrameResult, SensorNote, StageTimes
from selective_depth.app.viewer import Viewer, screenshot, sinks, viewer, window
from selective_depth.app.viewer.logger import DEPTH_COLOURS, ResultLogger
from selective_depth.app.viewer.stream import Recording
from selective_depth.drivers.errors import OutputError


def test_file_holds_every_step_bit_for_bit(tmp_path: Path) -> None:
    steps = [make_step(index) for index in range(12)]
    save(tmp_path / "out.rrd", steps)
    depths = images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16)
    masks = images_of(tmp_path / "out.rrd", "/camera/gas/mask", np.uint8)
    maps = images_of(tmp_path / "out.rrd", "/camera/improvement/score", np.uint8)
    assert len(depths) == len(masks) == len(maps) == len(steps)
    for step, depth, mask, levels in zip(steps, depths, masks, maps, strict=True):
        np.testing.assert_array_equal(depth, step.frame.depth_mm)
        np.testing.assert_array_equal(mask != 0, step.regions.mask)
        np.testing.assert_array_equal(levels != 0, step.improvement.known)
        shown = (levels.astype(np.float32) - 1) / 254
        known = step.improvement.known
        assert np.abs(shown[known] - step.improvement.score[known]).max() <= 1 / 254


def test_sensor_state_is_logged_when_it_changes(tmp_path: Path) -> None:
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd")
    shown = Viewer(chosen, live=False, times=StageTimes(), frames=100)
    shown.show(SensorNote("lost"))  # before the first frame there is no time to log it at
    shown.show(make_step(0))
    for state in ("stalled", "stalled", "lost", "reconnecting"):
        shown.show(SensorNote(state))
    shown.show(make_step(1))
    assert shown.close() == []
    states = []
    for chunk in RrdReader(str(tmp_path / "out.rrd")).stream():
        if chunk.entity_path == "/sensor/state" and not chunk.is_static:
            column = chunk.to_record_batch().column("StateChange:state")
            states += [value for row in column.to_pylist() for value in row]
    assert states == ["replay", "stalled", "lost", "reconnecting", "replay"]


def test_colour_limits_hold_for_the_whole_run(tmp_path: Path) -> None:
    near, far = dataclasses.replace(HEADLESS, near_mm=700, far_mm=4200), make_step(1)
    save(tmp_path / "out.rrd", [make_step(0), far], near_mm=near.near_mm, far_mm=near.far_mm)
    ranges = set()
    for chunk in RrdReader(str(tmp_path / "out.rrd")).stream():
        if chunk.entity_path == "/camera/depth" and chunk.is_static:
            for row in chunk.to_record_batch().column("DepthImage:depth_range").to_pylist():
                ranges.add(tuple(row[0]))
    assert ranges == {(700.0, 4200.0)}


@pytest.mark.parametrize("place", ["missing/out.rrd", ".", "/proc/out.rrd"])
def test_unwritable_file_is_refused_at_once(tmp_path: Path, place: str) -> None:
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / place)
    with pytest.raises(OutputError, match="cannot be written"):
        Viewer(chosen, live=False, times=StageTimes())


def test_a_refused_run_leaves_an_older_file_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "old.rrd").write_bytes(b"precious")
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "old.rrd", connect="rerun+http://127.0.0.1:1/proxy")
    with pytest.raises(ViewerError, match="no viewer listens"):
        Viewer(chosen, live=False, times=StageTimes())
    assert (tmp_path / "old.rrd").read_bytes() == b"precious"
    with pytest.raises(ViewerError, match="no viewer listens"):
        Viewer(dataclasses.replace(chosen, save=tmp_path / "new.rrd"), live=False, times=StageTimes())
    assert not (tmp_path / "new.rrd").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX locks")
def test_a_file_belongs_to_one_run_at_a_time(tmp_path: Path) -> None:
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd")
    shown = Viewer(chosen, live=False, times=StageTimes(), frames=2)
    with pytest.raises(OutputError, match="another run is writing"):
        Viewer(chosen, live=False, times=StageTimes())
    shown.show(make_step(0))
    assert shown.close() == []
    assert len(images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16)) == 1
    Viewer(chosen, live=False, times=StageTimes()).close()


def test_full_disk_ends_the_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd")
    shown = Viewer(chosen, live=False, times=StageTimes(), frames=100)
    usage = shutil.disk_usage(tmp_path)
    room = iter([1 << 30] * 3)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=next(room, 1 << 20)))
    with pytest.raises(OutputError, match="disk is full"):
        for index in range(100):
            shown.show(make_step(index))
    shown.close()
    depths = images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16)
    assert len(depths) == 3
    for index, depth in enumerate(depths):
        np.testing.assert_array_equal(depth, make_step(index).frame.depth_mm)


@pytest.mark.parametrize("live", [False, True])
def test_a_recording_waits_for_its_file_and_a_sensor_for_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, live: bool
) -> None:
    go_on = threading.Event()
    plain = ResultLogger.log

    def slow(self: ResultLogger, item: FrameResult) -> None:
        if live:
            go_on.wait()
        else:
            time.sleep(0.05)
        plain(self, item)

    monkeypatch.setattr(ResultLogger, "log", slow)
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd")
    shown = Viewer(chosen, live=live, times=StageTimes(), frames=100)
    for index in range(20):
        shown.show(make_step(index))
    dropped = sum(shown.dropped.values())
    go_on.set()
    assert shown.close() == []
    saved = len(images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16))
    assert (saved, dropped) == ((20 - dropped, 20 - saved) if live else (20, 0))
    if live:
        assert saved in (viewer.FILE_QUEUE, viewer.FILE_QUEUE + 1)  # and one in hand


def test_a_write_that_fails_costs_no_more_than_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd")
    monkeypatch.setattr(sinks, "CHECK_EVERY_S", 0.0)  # make sure after every step
    shown = Viewer(chosen, live=False, times=StageTimes(), frames=2000)
    plain, calls = Recording.flush, itertools.count()
    sure: list[int] = []

    def flush(self: Recording, timeout_s: float = 1e9) -> bool:
        done = plain(self, timeout_s)
        if next(calls) < 3:
            sure.append((tmp_path / "out.rrd").stat().st_size)
            return done
        return False

    monkeypatch.setattr(Recording, "flush", flush)
    with pytest.raises(OutputError, match=r"failed after [\d,]+ bytes, which are kept"):
        for index in range(100):
            shown.show(make_step(index))
    shown.close()
    assert (tmp_path / "out.rrd").stat().st_size == sure[-1]
    assert len(images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16)) == 3


@pytest.mark.parametrize("url", ["http://127.0.0.1:9876", "127.0.0.1:9876", "rerun+http:///proxy", "rubbish"])
def test_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ViewerError, match="not a viewer's address"):
        Viewer(dataclasses.replace(HEADLESS, connect=url), live=True, times=StageTimes())


def test_absent_viewer_is_noticed_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    chosen = dataclasses.replace(HEADLESS, connect=f"rerun+http://127.0.0.1:{port}/proxy")
    start_s = time.monotonic()
    with pytest.raises(ViewerError, match="no viewer listens"):
        Viewer(chosen, live=True, times=StageTimes())
    assert time.monotonic() - start_s < 2


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        *((address, "not an address") for address in ("9876", "localhost:", "localhost:99999", ":1")),
        ("nowhere.invalid:9876", "cannot serve on nowhere.invalid:9876"),
        ("192.0.2.1:9876", "cannot serve on 192.0.2.1:9876: Cannot assign"),
    ],
)
def test_serve_address_is_checked(address: str, reason: str) -> None:
    chosen = dataclasses.replace(HEADLESS, serve=True, serve_address=address)
    with pytest.raises(ViewerError, match=reason):
        Viewer(chosen, live=True, times=StageTimes())


@pytest.mark.parametrize("host", ["localhost", "0.0.0.0", "127.0.0.1", None])
def test_what_is_said_to_be_served_is_served_there(host: str | None) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    address = host and f"{host}:{port}"
    chosen = dataclasses.replace(HEADLESS, serve=True, serve_address=address)
    shown = Viewer(chosen, live=True, times=StageTimes())
    where = urlsplit(shown.served_url)
    assert where.hostname not in (None, "0.0.0.0", "localhost")
    assert window.listens((str(where.hostname), int(where.port or 0)))
    assert where.port == port if host else where.port in window.PORTS
    assert shown.close() == []


def test_two_runs_serve_on_ports_of_their_own() -> None:
    chosen = dataclasses.replace(HEADLESS, serve=True)
    runs = [Viewer(chosen, live=True, times=StageTimes()) for _ in range(2)]
    assert len({shown.served_url for shown in runs}) == 2
    for shown in runs:
        assert shown.close() == []


def test_taken_port_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        chosen = dataclasses.replace(HEADLESS, serve=True, serve_address=f"127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(ViewerError, match="cannot serve"):
            Viewer(chosen, live=True, times=StageTimes())


@pytest.fixture
def listener() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.kill()


def show_for(shown: Viewer, seconds: float, step: FrameResult) -> tuple[int, float]:
    """Show steps for a while; return how many and the longest time that one took."""
    count, longest_s = 0, 0.0
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        start_s = time.monotonic()
        shown.show(step)
        longest_s = max(longest_s, time.monotonic() - start_s)
        count += 1
        time.sleep(0.01)
    return count, longest_s


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no SIGSTOP on this system")
def test_stalled_viewer_holds_up_nobody_and_spares_the_file(listener: Listener, tmp_path: Path) -> None:
    options = dataclasses.replace(listener.options, save=tmp_path / "out.rrd")
    shown = Viewer(options, live=True, times=StageTimes(), frames=100)
    step = make_step(0)
    show_for(shown, 1.0, step)
    before = shown.dropped
    listener.process.send_signal(signal.SIGSTOP)
    count, longest_s = show_for(shown, 1.5, step)
    after = shown.dropped
    file, remote = after
    assert longest_s < 0.3
    assert after[remote] - before[remote] > count / 2
    assert after[file] - before[file] < count / 4  # a hundred a second is much for a busy machine
    start_s = time.monotonic()
    troubles = shown.close()
    assert time.monotonic() - start_s < 3
    assert len(troubles) == 1
    assert "stalled" in troubles[0]
    assert rows_of(tmp_path / "out.rrd")["/camera/depth"] > count / 2


def test_killed_viewer_is_found_again_when_it_is_back(listener: Listener) -> None:
    shown = Viewer(listener.options, live=True, times=StageTimes())
    step = make_step(0)
    show_for(shown, 1.0, step)
    listener.kill()
    count, longest_s = show_for(shown, 1.0, step)
    lost = sum(shown.dropped.values())
    assert longest_s < 0.3
    assert lost > count / 2
    listener.start()
    show_for(shown, 2.5, step)
    settled = sum(shown.dropped.values())
    count, _ = show_for(shown, 0.5, step)
    assert sum(shown.dropped.values()) - settled < count / 2
    assert shown.close() == []


def test_server_that_never_answers_ends_in_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        url = f"rerun+http://127.0.0.1:{mute.getsockname()[1]}/proxy"
        options = dataclasses.replace(HEADLESS, connect=url)
        shown = Viewer(options, live=True, times=StageTimes())
        _, longest_s = show_for(shown, 0.5, make_step(0))
        start_s = time.monotonic()
        troubles = shown.close()
    assert longest_s < 0.3
    assert time.monotonic() - start_s < 3
    assert "left behind" in troubles[0]


def test_two_that_have_stalled_are_left_behind_in_the_time_of_one(listener: Listener) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    options = dataclasses.replace(listener.options, serve=True, serve_address=address)
    shown = Viewer(options, live=True, times=StageTimes())
    with Listener(follow=shown.served_url) as second:
        show_for(shown, 0.5, make_step(0))
        for stopped in (listener, second):
            stopped.process.send_signal(signal.SIGSTOP)
        show_for(shown, 1.0, make_step(0))
        start_s = time.monotonic()
        troubles = shown.close()
        assert time.monotonic() - start_s < 3
    assert any("had stalled and was left behind" in trouble for trouble in troubles)


def test_two_places_see_the_same(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    options = dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd", serve=True, serve_address=address)
    shown = Viewer(options, live=False, times=StageTimes(), frames=100)
    for index in range(5):
        shown.show(make_step(index))
    assert shown.close() == []
    assert len(images_of(tmp_path / "out.rrd", "/camera/depth", np.uint16)) == 5


def picture_of(recording: Path, frame: int | None = None, **more: Any) -> np.ndarray:
    """A screenshot; no other trouble than a missing graphics driver is a reason to skip."""
    try:
        return screenshot(recording, frame, **more)
    except ViewerError as error:
        if "does not start" in str(error):
            pytest.skip(f"no graphics driver: {error}")
        raise


def test_a_picture_shows_the_frame_that_was_asked_for(tmp_path: Path) -> None:
    steps = []
    for index, far in enumerate((1000, 3000, 3000)):
        made = make_step(index)
        flat_mm = np.full((HEIGHT, WIDTH), far, np.uint16)
        frame = dataclasses.replace(made.frame, depth_mm=flat_mm)
        steps.append(dataclasses.replace(made, frame=frame))
    recording = tmp_path / "out.rrd"
    save(recording, steps, near_mm=1000, far_mm=3000)
    last, first = picture_of(recording), picture_of(recording, 0)
    for picture, level in ((last, 255), (first, 0)):
        view = picture[60:380, :540].reshape(-1, 3).astype(int)
        blue, green, red = (int(DEPTH_COLOURS[level]) >> shift & 255 for shift in (8, 16, 24))
        like = np.abs(view - (blue, green, red)).max(axis=1) < 12
        assert like.mean() > 0.3, "the frame's depth is not what is seen of the sensor"
    alone = picture_of(recording, time_s=0.02, view="sens", size=(400, 300))
    assert alone.shape[0] < 300 and 380 < alone.shape[1] <= 400
    middle = alone[100:150, 150:250].reshape(-1, 3).astype(int)
    assert (np.abs(middle - palette.channels(DEPTH_COLOURS[0])[::-1]).max(axis=1) < 12).all()


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"frame": 3}, r"--frame is 3; the frames of .* are 0\.\.2"),
        ({"time_s": 9.0}, r"--time is 9; the times of .* are 0\.\.0\.5"),
        ({"view": "7"}, r"--view is '7'; there are: 1 Sensor, In space\."),
    ],
)
def test_a_picture_of_what_is_not_there_is_refused(
    asked: dict[str, Any], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spans = [SimpleNamespace(name="frame", start=0, end=2), SimpleNamespace(name="time", start=0, end=500_000_000)]
    views = [SimpleNamespace(name=name, view_class="2D") for name in ("In space", "1 Sensor", "Stages: lines")]
    shown = SimpleNamespace(store_id="it", timelines=spans)
    state = SimpleNamespace(recordings=[shown], active_recording="it", loading=[], views=views)
    client = SimpleNamespace(open=lambda path: None, get_state=lambda: state)
    monkeypatch.setattr("rerun.experimental.ViewerClient.connect", lambda url: client)
    nobody = SimpleNamespace(wait=lambda: 0, kill=lambda: None)
    monkeypatch.setitem(screenshot.__globals__, "start", lambda *args, **more: (nobody, True))
    (tmp_path / "a.rrd").write_bytes(b"RRF2")
    with pytest.raises(UsageError, match=sentence):
        screenshot(tmp_path / "a.rrd", **asked)


def test_a_picture_of_a_recording_that_holds_nothing_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "out.rrd", [make_step(0)])
    data = (tmp_path / "out.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(data[:1000])
    with pytest.raises(ViewerError, match="finds nothing to show"):
        picture_of(tmp_path / "cut.rrd")


class SlowPage(http.server.BaseHTTPRequestHandler):
    """A page with the web viewer in it that takes its time to load.

    Chromium takes its picture when a page has loaded; the viewer is done long after that, so
    the page waits for an image that comes late.
    """

    viewer_url = ""

    def do_GET(self) -> None:
        if self.path != "/":
            time.sleep(40)
        self.send_response(200 if self.path == "/" else 404)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        if self.path == "/":
            style = "position:fixed;inset:0;width:100%;height:100%;border:0"
            page = f'<iframe src="{self.viewer_url}" style="{style}"></iframe><img src="/late.png">'
            self.wfile.write(page.encode())

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


@pytest.mark.browser
def test_web_viewer_shows_the_run(tmp_path: Path) -> None:
    """To be looked at with one's own eyes; here only that it is neither empty nor failing."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    executable = window.viewer_executable()
    if chromium is None or executable is None:
        pytest.skip("no Chromium, or no web viewer in the SDK")
    recording = tmp_path / "run.rrd"
    picture = Path(os.environ.get("WEB_PICTURE", tmp_path / "web.png")).resolve()
    source = os.environ.get("WEB_SOURCE", "virtual:workstation?frames=5")
    budget = ["--budget", "0.05", "--rounds", "4"]
    assert cli.run(["replay", source, "--headless", "--save", str(recording), *budget]) == 0
    ports = []
    for _ in range(2):
        with socket.create_server(("127.0.0.1", 0)) as free:
            ports.append(free.getsockname()[1])
    web, grpc = map(str, ports)
    serving = [executable, str(recording), "--serve-web", "--bind", "127.0.0.1"]
    server = subprocess.Popen(
        [*serving, "--web-viewer-port", web, "--port", grpc], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    stream = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{grpc}%2Fproxy"
    SlowPage.viewer_url = f"http://127.0.0.1:{web}/?url={stream}&renderer=webgl"
    pages = http.server.ThreadingHTTPServer(("127.0.0.1", 0), SlowPage)
    threading.Thread(target=pages.serve_forever, daemon=True).start()
    try:
        options = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
        options += ["--enable-unsafe-swiftshader", "--window-size=1920,1200", "--timeout=90000"]
        address = f"http://127.0.0.1:{pages.server_port}/"
        subprocess.run(
            [chromium, *options, f"--user-data-dir={tmp_path}", f"--screenshot={picture}", address],
            check=True,
            timeout=240,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    finally:
        pages.shutdown()
        server.kill()
        server.wait()
    image = cv2.imread(str(picture))
    assert image.shape[1] == 1920
    colourful = (image.max(axis=2) - image.min(axis=2)) > 60
    assert colourful.mean() > 0.05, "the web viewer shows no depth, regions or map"
