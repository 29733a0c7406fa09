"""The pipeline: every frame once, time kept, faults of the source survived or told."""

from __future__ import annotations

import dataclasses
import itertools
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.app import cli
from selective_depth.app.commands import session as session_module
from selective_depth.app.commands.session import Session
from selective_depth.app.console import interrupt
from selective_depth.app.pipeline import FrameResult, SensorNote, StageTimes, timing
from selective_depth.app.pipeline.governor import Eased
from selective_depth.app.pipeline.pipeline import EVEN_EVERY_LIVE, Pipeline
from selective_depth.app.pipeline.result import Model
from selective_depth.app.settings import AcquireOptions, GasOptions, RunOptions, SeedOptions, Settings, ViewerOptions
from selective_depth.app.viewer import Viewer
from selective_depth.drivers.errors import (
    DamagedRecordingError,
    DeviceLostError,
    SourceEndedError,
    SourceError,
    SourceTimeoutError,
)
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.realtime import RealtimeSource
from selective_depth.drivers.source import DepthSource
from selective_depth.selectors.acquire import Acquisition
from selective_depth.selectors.even import even_lattice
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.reconstruct import reconstruct

HEIGHT, WIDTH = 48, 64
SMALL = Settings(seeds=SeedOptions(24, 32), gas=GasOptions(nodes=60), viewer=ViewerOptions(headless=True))


def make_frame(index: int) -> DepthFrame:
    depth_mm = np.full((HEIGHT, WIDTH), 2000, dtype=np.uint16)
    depth_mm[:, WIDTH // 2 + index % 5 :] = 1200
    depth_mm[10:14, 10:20] = 0
    return DepthFrame(depth_mm, index, index * 33_333, Camera.kinect(WIDTH, HEIGHT), "made")


class Script(DepthSource):
    """A source that delivers frames and raises errors as it is told."""

    def __init__(self, events: list[int | SourceError], *, live: bool = False) -> None:
        self.uri = "script"
        self.camera = Camera.kinect(WIDTH, HEIGHT)
        self.fps = 30.0
        self.live = live
        self.frame_count = None if live else sum(isinstance(each, int) for each in events)
        self.dropped = 0
        self.closed = 0
        self._events = iter(events)

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        event = next(self._events, SourceEndedError("the end"))
        if isinstance(event, SourceError):
            self.state = "lost" if isinstance(event, DeviceLostError) else "stalled"
            raise event
        self.state = "live"
        return make_frame(event)

    def close(self) -> None:
        self.closed += 1


def run(monkeypatch: pytest.MonkeyPatch, source: DepthSource, settings: Settings = SMALL) -> tuple[int, Session]:
    monkeypatch.setattr(session_module, "open_and_tell", lambda uri: source)
    session = Session("script", settings)
    return session.run(), session


@pytest.mark.parametrize("budget", [0.0, 0.05])
def test_replay_takes_every_frame_once(monkeypatch: pytest.MonkeyPatch, budget: float) -> None:
    source = Script(list(range(7)))
    settings = dataclasses.replace(SMALL, acquire=AcquireOptions(budget=budget, rounds=2))
    code, session = run(monkeypatch, source, settings)
    report = session.report
    assert (code, report.frames, report.dropped, report.troubles) == (0, 7, 0, [])
    assert source.closed == 1
    expected = {"read", "seeds", "neural_gas", "improvement", "loop"}
    assert set(report.stages) == expected | ({"acquire", "model"} if budget else set())
    assert all(times.count == 7 for name, times in report.stages.items() if name != "read")
    assert report.means["rmse_mm"].count == (7 if budget else 0)
    assert session.last is not None
    assert session.last.frame.index == 6


def test_frames_limits_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = dataclasses.replace(SMALL, run=RunOptions(frames=3))
    code, session = run(monkeypatch, Script(list(range(7))), settings)
    assert (code, session.report.frames) == (0, 3)


def test_the_rate_is_that_of_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Script(list(range(8)))
    plain, shown_s, rates = source.read, list[float](), list[float]()

    def read(timeout_s: float = 5.0) -> DepthFrame:
        time.sleep(0.1)
        return plain(timeout_s)

    def show(self: Viewer, item: FrameResult | SensorNote) -> None:
        assert isinstance(item, FrameResult)
        shown_s.append(time.monotonic())
        rates.append(item.figures["fps"])

    monkeypatch.setattr(source, "read", read)
    monkeypatch.setattr(Viewer, "show", show)
    _, session = run(monkeypatch, source)
    # The first is timed from when all was ready, which nobody sees from here.
    began_s = shown_s[0] - 1 / rates[0]
    for count, (at_s, rate) in enumerate(zip(shown_s, rates, strict=True), start=1):
        assert rate == pytest.approx(count / (at_s - began_s), rel=0.1)
    assert session.report.fps == pytest.approx(rates[-1], rel=0.1)


def test_what_places_have_missed_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Viewer, "dropped", {"viewer window": 3})
    _, session = run(monkeypatch, Script([0, 1]))
    assert session.report.missed == {"viewer window": 3}


def test_a_lost_ctrl_c_ends_the_run_before_the_next_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Script(list(range(50)))
    plain, asked = source.read, threading.Event()

    def read(timeout_s: float = 5.0) -> DepthFrame:
        frame = plain(timeout_s)
        if frame.index == 2:
            asked.set()  # and nothing was raised
        return frame

    monkeypatch.setattr(source, "read", read)
    monkeypatch.setattr(interrupt, "_asked", asked)
    code, session = run(monkeypatch, source)
    assert code == 130
    assert session.report.frames <= 3


def test_live_goes_on_through_stall_and_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = [SourceTimeoutError("silent"), DeviceLostError("unplugged"), DeviceLostError("still")]
    source = Script([0, 1, *gone, 2, 3], live=True)
    code, session = run(monkeypatch, source)
    assert (code, session.report.frames) == (0, 4)
    assert session.report.live


def test_the_report_tells_the_sensors_last_state(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Script([0, 1, DeviceLostError("unplugged")], live=True)

    def read(timeout_s: float = 5.0, plain: Callable[[float], DepthFrame] = source.read) -> DepthFrame:
        if source.state == "lost":
            raise KeyboardInterrupt
        return plain(timeout_s)

    monkeypatch.setattr(source, "read", read)
    code, session = run(monkeypatch, source)
    assert (code, session.report.frames, session.report.state) == (130, 2, "lost")


def test_what_is_lost_while_starting_is_counted_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Script([0, 8, 9, 12], live=True)

    def read(timeout_s: float = 5.0, plain: Callable[[float], DepthFrame] = source.read) -> DepthFrame:
        frame = plain(timeout_s)
        source.dropped = {0: 0, 8: 7, 9: 7, 12: 9}[frame.index]
        return frame

    monkeypatch.setattr(source, "read", read)
    _, session = run(monkeypatch, source)
    assert (session.report.dropped_starting, session.report.dropped) == (7, 2)


ACQUIRING = dataclasses.replace(SMALL, acquire=AcquireOptions(budget=0.05, rounds=2))


def test_a_model_has_no_error_where_the_frame_has_no_depth() -> None:
    with Pipeline(ACQUIRING) as pipeline:
        step = pipeline.make(make_frame(0))
    assert step.model is not None
    np.testing.assert_array_equal(np.isnan(step.model.error_mm), step.frame.depth_mm == 0)


def test_a_sensors_frame_does_not_wait_for_the_even_model_and_one_gets_it(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, plain = threading.Event(), Model.of_even

    def slow(*what: Any) -> Model:
        go_on.wait(10)
        return plain(*what)

    monkeypatch.setattr(Model, "of_even", slow)
    with Pipeline(ACQUIRING, realtime=True) as pipeline:
        models = [pipeline.make(make_frame(index)).model for index in range(EVEN_EVERY_LIVE + 1)]
        assert all(model is not None and model.even is None for model in models)
        go_on.set()
        assert pipeline._even is not None
        made = pipeline._even.result()
        assert (later := pipeline.make(make_frame(9)).model) is not None
    assert later.even is made


@pytest.mark.parametrize(("asked", "frames"), [(None, [0]), (3, [0, 3, 6, 9]), (0, [])])
def test_a_recordings_frames_have_the_even_model_as_often_as_asked(asked: int | None, frames: list[int]) -> None:
    settings = dataclasses.replace(SMALL, acquire=AcquireOptions(budget=0.05, even_every=asked))
    with Pipeline(settings) as pipeline:
        models = [pipeline.make(make_frame(index)).model for index in range(10)]
    assert [index for index, model in enumerate(models) if model is not None and model.even is not None] == frames


def test_the_even_model_is_that_of_as_many_measurements() -> None:
    with Pipeline(ACQUIRING) as pipeline:
        result = pipeline.make(make_frame(0))
    assert result.model is not None and result.model.even is not None and result.acquisition is not None
    uv = even_lattice(result.frame.shape, len(result.acquisition.uv))
    even_mm = reconstruct(uv, result.frame.measure(uv), result.frame.shape)
    np.testing.assert_array_equal(result.model.even.depth_mm, even_mm)
    assert result.model.even.rmse_mm == pytest.approx(errors_of(even_mm, result.frame.depth_mm).rmse_mm)


def test_options_changed_on_the_way_hold_from_the_next_frame_on() -> None:
    with Pipeline(ACQUIRING) as pipeline:
        pipeline.begin(make_frame(0))
        more = AcquireOptions(budget=0.1, rounds=3, by="even")
        pipeline.adopt(dataclasses.replace(ACQUIRING, acquire=more))
        pipeline.begin(make_frame(1))
        before, after = (result.acquisition for result in pipeline.rest())
    assert before is not None and after is not None
    assert (before.by, len(before.rounds)) == ("surface score", 2)
    assert (after.by, len(after.rounds)) == ("even", 3)
    assert sum(each.shots for each in after.rounds) > 1.9 * sum(each.shots for each in before.rounds)


def test_what_the_governor_leaves_out_is_left_out() -> None:
    asked = dataclasses.replace(SMALL, acquire=AcquireOptions(budget=0.05, rounds=4))
    with Pipeline(asked) as pipeline:
        pipeline.ease(Eased(model_every=2, rounds=2, gas_every=2))
        results = [pipeline.make(make_frame(index)) for index in range(4)]
    assert [result.model is None for result in results] == [False, True, False, True]
    assert {len(result.acquisition.rounds) for result in results if result.acquisition} == {2}
    assert results[1].regions is results[0].regions and results[2].regions is not results[1].regions


def test_stage_loop_holds_what_the_loop_itself_did(monkeypatch: pytest.MonkeyPatch) -> None:
    with Pipeline(SMALL) as pipeline:
        pipeline.warm_up(make_frame(0))
        train = pipeline._gas.update if pipeline._live_gas else pipeline._gas.select
        # As slow as to outlast all that is done beside it.
        monkeypatch.setattr(pipeline._gas, train.__name__, lambda seeds: (time.sleep(0.1), train(seeds))[1])
        pipeline.make(make_frame(1))
    stages = pipeline.times.summary()
    assert stages["neural_gas"].max_ms >= 100
    assert stages["loop"].max_ms >= stages["seeds"].max_ms + stages["neural_gas"].max_ms


def test_a_step_has_the_times_of_its_own_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the next frame is under way when it is made."""
    with Pipeline(ACQUIRING) as pipeline:
        pipeline.warm_up(make_frame(0))
        select, calls = pipeline._improvement.select, itertools.count()
        monkeypatch.setattr(
            pipeline._improvement, "select", lambda seeds: (time.sleep(0.3 * (next(calls) == 3)), select(seeds))[1]
        )
        steps = []
        for index in range(6):
            pipeline.begin(make_frame(index), read_ms=float(index))
            steps += pipeline.finished()
        steps += pipeline.rest()
    assert [step.stages_ms["read"] for step in steps] == [0, 1, 2, 3, 4, 5]
    assert max(range(6), key=lambda index: steps[index].stages_ms["improvement"]) == 3
    own = {"read", "seeds", "neural_gas", "improvement", "acquire", "model", "loop"}
    assert all(set(step.stages_ms) == own for step in steps)


def test_starting_is_over_before_times_count(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Acquisition.reconstruct

    def slow(self: Acquisition, threads: int | None = None) -> npt.NDArray[np.float32]:
        time.sleep(0.1)
        return plain(self, threads)

    monkeypatch.setattr(Acquisition, "reconstruct", slow)
    with Pipeline(ACQUIRING, realtime=True) as pipeline:
        pipeline.warm_up(make_frame(0))
    assert pipeline.times.summary() == {}


def test_a_closed_loop_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    with Pipeline(ACQUIRING, realtime=True) as pipeline:
        pipeline.make(make_frame(0))
    left = {thread.name for thread in set(threading.enumerate()) - before}
    assert not [name for name in left if name.startswith(("beside", "even"))]


@pytest.mark.parametrize(("budget", "realtime"), [(0.05, False), (0.05, True), (0.0, True)])
def test_results_come_in_order_and_none_is_held_back_from_silence(budget: float, realtime: bool) -> None:
    """Frames overlap; the results are those of one frame at a time."""
    settings = dataclasses.replace(SMALL, acquire=AcquireOptions(budget=budget, rounds=2))
    done: list[FrameResult] = []
    ahead: list[int] = []
    with Pipeline(settings, realtime=realtime) as pipeline, Pipeline(settings) as plain:
        for index in range(6):
            pipeline.begin(make_frame(index), state=f"state {index}")
            done += pipeline.finished()
            ahead.append(index + 1 - len(done))
        done += pipeline.rest()  # none comes for a while
        assert len(done) == 6, "a result waits for a frame that does not come"
        pipeline.begin(make_frame(6), state="state 6")
        done += pipeline.rest()
        for index, result in enumerate(done):
            expected = plain.make(make_frame(index))
            assert (result.frame.index, result.state) == (index, f"state {index}")
            np.testing.assert_array_equal(result.regions.mask, expected.regions.mask)
            np.testing.assert_array_equal(result.improvement.score, expected.improvement.score)
            if result.acquisition is not None and expected.acquisition is not None:
                np.testing.assert_array_equal(result.acquisition.uv, expected.acquisition.uv)
    assert len(done) == 7
    assert max(ahead) == (1 if budget or not realtime else 0)


def test_damaged_recording_ends_with_what_was_read(monkeypatch: pytest.MonkeyPatch) -> None:
    damage = DamagedRecordingError("frame 3 of 'walk.oni' is damaged; use check --repair")
    code, session = run(monkeypatch, Script([0, 1, 2, damage]))
    assert (code, session.report.frames) == (1, 3)
    assert session.report.troubles == [str(damage)]


def test_replay_that_times_out_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceTimeoutError):
        run(monkeypatch, Script([0, SourceTimeoutError("no frame within 5 s")]))


def test_source_is_closed_when_a_selector_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Script([0, 1])
    monkeypatch.setattr(Pipeline, "make", lambda *_: (_ for _ in ()).throw(MemoryError("full")))
    with pytest.raises(MemoryError):
        run(monkeypatch, source)
    assert source.closed == 1


def test_saved_run_writes_settings_and_picture_beside(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    viewer = ViewerOptions(headless=True, save=tmp_path / "run.rrd")
    code, session = run(monkeypatch, Script([0, 1]), dataclasses.replace(SMALL, viewer=viewer))
    assert code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run.rrd", "run.toml", "run.png"}
    assert set(session.report.written) == set(tmp_path.iterdir())


def test_realtime_keeps_time_and_counts_what_nobody_read() -> None:
    with RealtimeSource(Script(list(range(12)))) as source:
        assert source.read().index == 0
        time.sleep(0.2)
        assert source.read().index == 1  # the clock starts here
        time.sleep(0.2)
        assert source.read().index >= 5  # frames come every 33 ms
        seen = 3
        while True:
            try:
                source.read()
            except SourceEndedError:
                break
            seen += 1
        assert seen + source.dropped == 12


def test_realtime_passes_faults_on_and_bounds_its_wait() -> None:
    with RealtimeSource(Script([0, DamagedRecordingError("damaged")])) as source:
        assert source.read().index == 0
        with pytest.raises(DamagedRecordingError):
            source.read()
    blocked = Script([0])
    release = threading.Event()
    blocked.read = lambda timeout_s=5.0: release.wait() and make_frame(0)  # type: ignore[method-assign,assignment]
    with RealtimeSource(blocked) as source:
        with pytest.raises(SourceTimeoutError, match=r"within 0\.1 s"):
            source.read(0.1)
        release.set()


def test_realtime_passes_on_what_no_source_should_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script([0])

    def read(timeout_s: float = 5.0) -> DepthFrame:
        raise OSError("the disk is gone")

    monkeypatch.setattr(script, "read", read)
    with RealtimeSource(script) as source, pytest.raises(OSError, match="the disk is gone"):
        source.read(2)
    assert script.closed == 1


def test_realtime_waits_for_a_reader_that_had_to_ask_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads that timed out before the first frame do not start the clock."""
    script = Script(list(range(12)))
    release, plain = threading.Event(), script.read

    def read(timeout_s: float = 5.0) -> DepthFrame:
        release.wait()
        return plain(timeout_s)

    monkeypatch.setattr(script, "read", read)
    with RealtimeSource(script) as source:
        for _ in range(3):
            with pytest.raises(SourceTimeoutError):
                source.read(0.01)
        release.set()
        assert source.read().index == 0
        time.sleep(0.2)
        assert source.read().index == 1
        assert source.dropped == 0


@given(st.lists(st.floats(0, 1e4, width=32), min_size=1, max_size=50))
def test_stage_times_agree_with_numpy(durations_ms: list[float]) -> None:
    times = StageTimes()
    for each in durations_ms:
        times.add("loop", each)
    summary = times.summary()["loop"]
    assert summary.count == len(durations_ms)
    assert summary.max_ms == max(durations_ms)
    expected = np.percentile(np.array(durations_ms, dtype=np.float32), (50, 99))
    np.testing.assert_allclose((summary.p50_ms, summary.p99_ms), expected, rtol=1e-6)


def test_stage_times_stay_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "KEPT", 8)
    times = StageTimes()
    for each in [1000.0] + [1.0] * 100:
        times.add("loop", each)
    summary = times.summary()["loop"]
    assert (summary.p50_ms, summary.p99_ms, summary.max_ms) == (1.0, 1.0, 1000.0)
    assert summary.count == 101


def test_failed_stage_is_not_counted() -> None:
    times = StageTimes()
    with pytest.raises(ValueError, match="bad"), times.stage("loop"):
        raise ValueError("bad")
    assert times.summary() == {}


def test_without_a_display_the_run_is_saved(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    settings = dataclasses.replace(SMALL, viewer=ViewerOptions())
    code, _ = run(monkeypatch, Script([0, 1]), settings)
    assert code == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"replay.rrd", "replay.toml", "replay.png"}
    assert "No display here" in capsys.readouterr().out


def test_the_end_report_says_the_gain(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["replay", "virtual:ball?size=160x120&frames=12&noise=off", "--headless", "--budget", "5%"]
    assert cli.run([*words, "--seeds.rows", "32", "--seeds.columns", "32", "--gas.nodes", "60"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if "times as good" in line)
    found = re.fullmatch(r"(.+)% of the pixels · (.+) mm · even lattice (.+) mm · (.+) times as good", line)
    assert found is not None
    share, model_mm, even_mm, times = map(float, found.groups())
    assert share == pytest.approx(100 * (32 * 32 + 960) / (160 * 120), abs=0.1)
    assert times == pytest.approx(even_mm / model_mm, rel=0.1) and times > 1
