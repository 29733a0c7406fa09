"""What a run leaves out where it cannot keep up: in which order, when it comes back, that it settles."""

from __future__ import annotations

from itertools import pairwise

import pytest

from selective_depth.app.pipeline.governor import ALL, PATIENCE, WINDOW, Governor, levels
from selective_depth.app.settings import AcquireOptions

PERIOD_MS = 1000 / 30
FULL = AcquireOptions(budget=0.05, rounds=4)


def said(options: AcquireOptions) -> list[str]:
    return [each.said for each in levels(options)]


def test_the_order_is_the_one_that_is_documented() -> None:
    assert said(FULL) == [
        "",
        "model every 2nd frame",
        "model every 2nd frame, 2 rounds instead of 4",
        "model every 2nd frame, 2 rounds instead of 4, neural gas every 2nd frame",
    ]
    assert [(each.model_every, min(each.rounds, 4), each.gas_every) for each in levels(FULL)] == [
        (1, 4, 1), (2, 4, 1), (2, 2, 1), (2, 2, 2),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "last"),
    [
        (AcquireOptions(), "neural gas every 2nd frame"),
        (AcquireOptions(budget=0.02, memory="still"), "neural gas every 2nd frame"),
        (AcquireOptions(budget=0.02, rounds=2), "model every 2nd frame, neural gas every 2nd frame"),
    ],
)
def test_only_what_there_is_can_be_left_out(options: AcquireOptions, last: str) -> None:
    assert said(options)[-1] == last


class Machine:
    """A machine that needs so long for a frame, at each step, and the sensor it reads."""

    def __init__(self, needs_ms: tuple[float, ...]) -> None:
        self.needs_ms, self.lag_ms, self.governor = needs_ms, 0.0, Governor(FULL, PERIOD_MS)
        self.levels: list[int] = []

    def run(self, frames: int) -> None:
        ladder = levels(FULL)
        for _ in range(frames):
            level = ladder.index(self.governor.eased)
            self.lag_ms += self.needs_ms[level] - PERIOD_MS
            skipped = 0
            while self.lag_ms > PERIOD_MS:
                self.lag_ms, skipped = self.lag_ms - PERIOD_MS, skipped + 1
            waited_ms = max(0.0, -self.lag_ms)
            self.lag_ms = max(0.0, self.lag_ms)
            self.governor.note(skipped, waited_ms)
            self.levels.append(level)


def test_a_fast_machine_leaves_nothing_out() -> None:
    machine = Machine((20, 15, 12, 10))
    machine.run(2000)
    assert set(machine.levels) == {0} and machine.governor.frames == 0 and machine.governor.most == ALL


def test_a_slow_machine_goes_as_far_as_it_must() -> None:
    machine = Machine((60, 45, 32, 20))
    machine.run(2000)
    assert machine.levels[-1] == 2
    assert machine.governor.most == levels(FULL)[2]


def test_it_never_goes_below_the_last_step() -> None:
    machine = Machine((200, 150, 120, 100))
    machine.run(500)
    assert machine.levels[-1] == 3


def test_what_was_left_out_comes_back_when_there_is_time_again() -> None:
    machine = Machine((60, 45, 32, 20))
    machine.run(300)
    machine.needs_ms = (20, 15, 12, 10)
    machine.run(20 * WINDOW)
    assert machine.levels[-1] == 0


def test_trying_again_and_again_becomes_rare() -> None:
    """At the third step there is time to spare, at the second there is not."""
    machine = Machine((60, 45, 40, 20))
    machine.run(400 * WINDOW)
    tries = [
        at for at, (before, now) in enumerate(zip(machine.levels, machine.levels[1:], strict=False)) if now < before
    ]
    gaps = [after - before for before, after in pairwise(tries)]
    assert tries and gaps[-1] >= PATIENCE[1] * WINDOW > 4 * gaps[0]


def test_one_frame_that_is_skipped_means_nothing() -> None:
    governor = Governor(FULL, PERIOD_MS)
    assert not any(governor.note(int(at % WINDOW == 7), 20.0) for at in range(20 * WINDOW))


def test_new_options_are_begun_with_all_of_them() -> None:
    machine = Machine((60, 45, 32, 20))
    machine.run(300)
    machine.governor.restart(AcquireOptions(budget=0.01))
    assert machine.governor.eased == ALL
