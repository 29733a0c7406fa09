"""Handing over: nothing lost where all must arrive, nobody waits where time matters."""

from __future__ import annotations

import math
import threading
import time

import pytest

from selective_depth.app.viewer.handover import Handover


class Gate:
    """A sink that takes items only while it is open."""

    name = "gate"

    def __init__(self) -> None:
        self.opened = threading.Event()
        self.taken: list[int] = []
        self.closed = False
        self.busy = threading.Event()

    def open(self) -> None:
        pass

    def put(self, item: int, /) -> None:
        self.busy.set()
        self.opened.wait()
        if item < 0:
            raise OSError("broken")
        self.taken.append(item)

    def close(self) -> None:
        self.closed = True


def test_infinite_patience_delivers_everything_in_order() -> None:
    gate = Gate()
    gate.opened.set()
    handover = Handover(gate, patience_s=math.inf)
    for item in range(500):
        handover.offer(item)
    assert handover.finish(5)
    assert gate.taken == list(range(500))
    assert handover.dropped == 0
    assert gate.closed


def test_stalled_sink_costs_items_but_no_time() -> None:
    gate = Gate()
    handover = Handover(gate, capacity=2)
    handover.offer(0)
    gate.busy.wait()
    start_s = time.monotonic()
    for item in range(1, 1000):
        handover.offer(item)
    assert time.monotonic() - start_s < 1
    assert handover.dropped == 997  # one in the sink's hands, two waiting
    gate.opened.set()
    assert handover.finish(5)
    assert gate.taken == [0, 998, 999]


def test_patience_is_spent_once() -> None:
    gate = Gate()
    handover = Handover(gate, patience_s=0.2, capacity=1)
    handover.offer(0)
    gate.busy.wait()
    start_s = time.monotonic()
    for item in range(1, 20):
        handover.offer(item)
    assert 0.2 <= time.monotonic() - start_s < 1.5
    gate.opened.set()
    assert handover.finish(5)


def test_slow_sink_is_waited_for() -> None:
    gate = Gate()
    handover = Handover(gate, patience_s=5, capacity=1)
    threading.Timer(0.1, gate.opened.set).start()
    for item in range(50):
        handover.offer(item)
    assert handover.finish(5)
    assert gate.taken == list(range(50))


@pytest.mark.parametrize("patience_s", [0, math.inf])
def test_failure_is_told_and_blocks_nobody(patience_s: float) -> None:
    gate = Gate()
    gate.opened.set()
    handover = Handover(gate, patience_s=patience_s, capacity=1)
    handover.offer(-1)
    gate.busy.wait()
    for item in range(100):
        handover.offer(item)
    assert handover.finish(5)
    assert isinstance(handover.failure, OSError)
    assert handover.dropped + len(gate.taken) >= 98


def test_finish_leaves_a_stalled_sink_behind() -> None:
    gate = Gate()
    handover = Handover(gate)
    for item in range(3):
        handover.offer(item)
    start_s = time.monotonic()
    assert not handover.finish(0.2)
    assert time.monotonic() - start_s < 1
    gate.opened.set()


def test_what_a_failed_sink_had_in_hand_and_before_it_is_dropped() -> None:
    gate = Gate()
    handover = Handover(gate)
    for item in (-1, 1, 2):
        handover.offer(item)
        gate.busy.wait()
    gate.opened.set()
    assert handover.finish(5)
    assert handover.dropped == 3
    handover.offer(3)
    assert handover.dropped == 4


def test_what_a_sink_took_before_it_failed_is_not_dropped() -> None:
    gate = Gate()
    gate.opened.set()
    handover = Handover(gate, patience_s=math.inf)
    for item in (1, 2, -1):
        handover.offer(item)
    assert handover.finish(5)
    assert (gate.taken, handover.dropped) == ([1, 2], 1)


def test_what_a_sink_left_behind_had_in_hand_and_before_it_is_dropped() -> None:
    gate = Gate()
    handover = Handover(gate)
    for item in range(3):
        handover.offer(item)
        gate.busy.wait()
    assert not handover.finish(0.05)
    assert handover.dropped == 3
    gate.opened.set()


def test_a_sink_that_does_not_open_is_waited_for_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError("no viewer")

    gate = Gate()
    monkeypatch.setattr(gate, "open", refuse)
    handover = Handover(gate)
    assert handover.ready.wait(2)
    assert isinstance(handover.failure, OSError)


def test_patience_is_back_after_a_stall() -> None:
    gate = Gate()
    handover = Handover(gate, patience_s=0.05, capacity=1)
    handover.offer(0)
    gate.busy.wait()
    handover.offer(1)
    handover.offer(2)  # patience runs out, 1 goes
    gate.opened.set()
    deadline = time.monotonic() + 5
    while len(gate.taken) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    gate.opened.clear()
    gate.busy.clear()
    handover._patience_s = 5
    handover.offer(3)
    gate.busy.wait()
    handover.offer(4)
    threading.Timer(0.1, gate.opened.set).start()
    handover.offer(5)
    assert handover.finish(5)
    assert gate.taken == [0, 2, 3, 4, 5]
    assert handover.dropped == 1
