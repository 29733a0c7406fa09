"""A run that is changed while it goes on: by whoever holds its steering, and by the terminal's keys."""

from __future__ import annotations

import dataclasses
import os
import pty
import re
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from selective_depth.app.commands.session import Session
from selective_depth.app.commands.steering import BUDGETS, MEMORY_BUDGET, Status, Steering, changed
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline.pipeline import Pipeline
from selective_depth.app.pipeline.selecting import SELECTOR_NAMES
from selective_depth.app.settings import AcquireOptions, GasOptions, PlayOptions, SeedOptions, Settings, ViewerOptions
from selective_depth.drivers.open import open_source

SMALL = Settings(
    seeds=SeedOptions(24, 32),
    gas=GasOptions(nodes=60),
    acquire=AcquireOptions(budget=0.05),
    viewer=ViewerOptions(headless=True),
)
LIVE = "virtual:ball?size=160x120&live=1"
PATIENCE_S = 20.0


def until(true: Callable[[], object], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline_s, f"not within {PATIENCE_S:g} s: {what}"
        time.sleep(0.01)


@contextmanager
def running(uri: str, settings: Settings = SMALL) -> Iterator[tuple[Session, Steering, Callable[[], Status]]]:
    """A run in another thread, which is stopped at the end; its own errors are raised here."""
    steering = Steering()
    session = Session(uri, settings, steering)
    failed: list[BaseException] = []

    def run() -> None:
        try:
            session.run()
        except BaseException as error:  # noqa: BLE001 - raised where the test is
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()

    def status() -> Status:
        assert steering.status is not None
        return steering.status

    try:
        until(lambda: failed or (steering.status and steering.status.frames > 1), "two frames")
        yield session, steering, status
    finally:
        steering.ask("stop")
        thread.join(PATIENCE_S)
    assert not failed and not thread.is_alive()
    assert status().ended


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_options_change_while_a_run_goes_on() -> None:
    with running(LIVE) as (session, steering, status):
        for name, value in (("budget", 0.1), ("rounds", 3), ("by", "even")):
            steering.ask(name, value)
            until(lambda name=name, value=value: getattr(status().acquire, name) == value, name)
        frames = status().frames
        until(lambda: status().frames > frames + 3, "frames by the new options")
        assert session.last is not None and session.last.acquisition is not None
        assert session.last.acquisition.by == "even" and len(session.last.acquisition.rounds) == 3
    assert session.report.changes == 3
    assert session.report.by == "even"
    assert session.report.means["measured_percent"].value == pytest.approx(100 * (24 * 32 / 19200 + 0.1), abs=0.5)


def test_a_memory_is_begun_kept_and_forgotten() -> None:
    with running("virtual:ball?size=160x120&live=1&speed=0") as (session, steering, _):
        steering.ask("memory", "still")
        until(lambda: session.last is not None and session.last.memory is not None, "a memory")

        def known() -> float:
            assert session.last is not None
            return session.last.figures["known_percent"]

        until(lambda: known() > 30, "a third of the pixels known")
        steering.ask("reset")
        until(lambda: known() < 25, "most of it forgotten")


def test_a_paused_run_reads_no_recording_and_counts_no_frame_of_a_sensor_as_skipped() -> None:
    for uri in (LIVE, "virtual:ball?size=160x120&frames=100000"):
        with running(uri) as (session, steering, status):
            steering.ask("paused", True)
            until(lambda: status().paused, "a pause")
            frames, skipped = status().frames, status().skipped
            time.sleep(0.5)
            assert status().frames <= frames + 1  # what was under way
            steering.ask("paused", False)
            until(lambda before=frames: status().frames > before + 5, "frames after it")
            assert status().skipped - skipped < 8  # half a second are 15
        assert session.report.dropped < 15


def test_frames_are_recorded_from_start_to_stop_and_replay() -> None:
    with running("virtual:ball?size=160x120&frames=100000", dataclasses.replace(SMALL, play=PlayOptions())) as (
        session,
        steering,
        status,
    ):
        steering.ask("recording", True)
        until(lambda: status().recording, "a recording")
        frames = status().frames
        until(lambda: status().frames > frames + 10, "ten frames")
        steering.ask("recording", False)
        until(lambda: any("Recorded" in each for each in status().news), "its end")
    (path,) = Path("out").glob("record-*.oni")
    count = session.report.recorded[path][0]
    assert count >= 10 and session.report.written == [path]
    with open_source(path) as there, open_source("virtual:ball?size=160x120&frames=100000") as made:
        recorded = list(there)
        first = recorded[0].depth_mm
        same = next(frame for frame in made if np.array_equal(frame.depth_mm, first))
        for before, after in zip([same, *(made.read() for _ in range(count - 1))], recorded, strict=True):
            np.testing.assert_array_equal(before.depth_mm, after.depth_mm)


def test_a_run_that_ends_while_it_records_finishes_the_file() -> None:
    settings = dataclasses.replace(SMALL, viewer=dataclasses.replace(SMALL.viewer, record=Path("walk.oni")))
    with running(LIVE, settings) as (session, _, status):
        until(lambda: status().frames > 10, "ten frames")
    assert session.report.written == [Path("walk.oni")]
    assert session.report.recorded[Path("walk.oni")][0] >= 10
    with open_source("walk.oni") as source:
        assert len(list(source)) == session.report.recorded[Path("walk.oni")][0]


def test_a_picture_is_taken() -> None:
    with running(LIVE) as (_, steering, status):
        steering.ask("snapshot")
        until(lambda: any("Wrote" in each for each in status().news), "a picture")
    (picture,) = Path("out").glob("picture-*.png")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_place_that_cannot_be_written_does_not_end_the_run() -> None:
    Path("out").write_text("a file where the folder would be")
    with running(LIVE) as (_, steering, status):
        steering.ask("recording", True)
        until(lambda: any("out" in each for each in status().news), "why there is none")
        frames = status().frames
        until(lambda: status().frames > frames + 3, "frames after it")
        assert not status().recording


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("budget", 1.5), ("budget", "all"), ("budget", float("nan")), ("rounds", 0), ("rounds", 2.5),
        ("by", "/etc/x.py:f"), ("by", "evil.py:run"), ("memory", "on"), ("layout", "x"), ("hide", ["x"]),
        ("paused", 1), ("recording", "/etc/passwd"), ("snapshot", "a.png"), ("save", "a.rrd"), ("", None),
    ],
)  # fmt: skip
def test_nothing_else_can_be_asked_for(name: str, value: Any) -> None:
    """Neither names of files nor code, whatever a page sends."""
    steering = Steering()
    with pytest.raises(UsageError, match="a run cannot be asked for"):
        steering.ask(name, value)
    assert steering.take() == []


def test_a_memory_always_has_something_to_spend() -> None:
    nothing = dataclasses.replace(SMALL, acquire=AcquireOptions())
    remembering = changed(nothing, "memory", "still")
    assert remembering.acquire.budget == MEMORY_BUDGET
    assert changed(remembering, "budget", 0.0).acquire.memory == "off"


def test_everything_that_can_be_switched_to_is_compiled_before() -> None:
    from selective_depth.drivers.frame import Camera, DepthFrame

    depth_mm = np.full((48, 64), 2000, np.uint16)
    depth_mm[:, 32:] = 1200
    with Pipeline(SMALL) as pipeline:
        pipeline.warm_up_all(DepthFrame(depth_mm, 0, 0, Camera.kinect(64, 48)))
        assert pipeline._asked.settings == SMALL
        assert pipeline.times.summary() == {}


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("+", ("budget", 0.1)), ("-", ("budget", 0.02)), ("]", ("rounds", 3)), ("[", ("rounds", 1)),
        ("s", ("by", SELECTOR_NAMES[1])), ("m", ("memory", "still")), (" ", ("paused", True)),
        ("r", ("recording", True)),
        ("p", ("snapshot", None)), ("l", ("layout", "visitor")), ("x", ("reset", None)), ("q", ("stop", None)),
    ],
)  # fmt: skip
def test_keys_ask_for_what_they_say(key: str, expected: tuple[str, Any]) -> None:
    steering = Steering()
    assert steering.meant(key) is None  # before the run has begun
    steering.status = Status(SMALL.acquire, SMALL.viewer)
    assert steering.meant(key) == expected
    assert steering.meant("?") is None


def test_keys_that_come_faster_than_frames_are_all_obeyed() -> None:
    with running(LIVE) as (_, steering, status):
        for key in "++]s?rr":
            steering.press(key)
        until(lambda: status().acquire.by == SELECTOR_NAMES[1], "the last of them")
        assert (status().acquire.budget, status().acquire.rounds) == (0.2, 3)
        until(
            lambda: any("Recorded" in each or "holds no frame" in each for each in status().news), "a recording's end"
        )
        assert not status().recording


def test_budgets_end_at_their_ends() -> None:
    steering = Steering()
    for budget, key in ((BUDGETS[-1], "+"), (0.0, "-")):
        steering.status = Status(AcquireOptions(budget=budget), SMALL.viewer)
        assert steering.meant(key) == ("budget", budget)


def test_keys_of_a_real_terminal_steer_a_run_and_leave_it_as_it_was(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "selective_depth.app", "replay", LIVE, "--budget", "5%", "--headless"]
    command += ["--seeds.rows", "24", "--seeds.columns", "32"]
    child, terminal = pty.fork()
    if child == 0:
        os.execve(command[0], command, os.environ | {"COLUMNS": "100", "TERM": "xterm"})
    shown = b""

    def wait_for(words: str) -> None:
        nonlocal shown
        deadline_s = time.monotonic() + 3 * PATIENCE_S
        while not re.search(words.encode(), shown):
            assert time.monotonic() < deadline_s, shown.decode(errors="replace")
            if select.select([terminal], [], [], 0.1)[0]:
                try:
                    shown += os.read(terminal, 1 << 16)
                except OSError:  # it has ended
                    assert re.search(words.encode(), shown), shown.decode(errors="replace")

    wait_for("s selector")
    wait_for("frames/s")
    os.write(terminal, b"r")
    wait_for("Recording to")
    os.write(terminal, b"r")
    wait_for("Recorded")
    os.write(terminal, b"s")
    os.write(terminal, b"q")
    wait_for("options changed")
    wait_for("wrote out/record-")
    os.waitpid(child, 0)
    os.close(terminal)


def test_without_a_terminal_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    from selective_depth.app.console.keys import pressed

    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        with pressed(lambda key: None) as there:
            assert not there
