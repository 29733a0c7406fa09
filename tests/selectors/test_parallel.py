"""Bands of rows: every row once, and no band outlives the call."""

from __future__ import annotations

import threading
import time
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.selectors.parallel import at_once, default_threads, in_bands


@given(st.integers(0, 50), st.integers(1, 9))
def test_every_row_is_done_once(rows: int, threads: int) -> None:
    done = np.zeros(rows, int)

    def kernel(first: int, end: int) -> None:
        done[first:end] += 1

    in_bands(kernel, rows, threads)
    assert (done == 1).all()


def test_a_failing_band_is_heard_after_all_have_ended() -> None:
    running = threading.Event()
    ended = threading.Event()

    def kernel(first: int, end: int) -> None:
        if first == 0:
            assert running.wait(5)
            raise ValueError("first band")
        running.set()
        time.sleep(0.05)
        ended.set()

    with pytest.raises(ValueError, match="first band"):
        in_bands(kernel, 2, threads=2)
    assert ended.is_set()


def test_threads_can_be_set_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SELECTIVE_DEPTH_THREADS", "3")
    assert default_threads() == 3
    monkeypatch.setenv("SELECTIVE_DEPTH_THREADS", "none")
    assert default_threads() >= 1


def test_bands_take_alike_where_costs_are_told() -> None:
    cost = np.array([1, 1, 1, 1, 8, 1, 1, 1, 1], np.float32)
    bands: list[tuple[int, int]] = []
    in_bands(lambda first, end: bands.append((first, end)), len(cost), 3, cost=cost)
    bands.sort()
    assert [first for first, _ in bands[1:]] == [end for _, end in bands[:-1]]
    assert (bands[0][0], bands[-1][1]) == (0, len(cost))
    assert max(cost[first:end].sum() for first, end in bands) <= 9


@given(st.lists(st.floats(0, 100, width=32), min_size=1, max_size=40), st.integers(1, 9))
def test_whatever_the_costs_every_row_is_done_once(costs: list[float], threads: int) -> None:
    done = np.zeros(len(costs), int)

    def kernel(first: int, end: int) -> None:
        done[first:end] += 1

    in_bands(kernel, len(costs), threads, cost=np.array(costs, np.float32))
    assert (done == 1).all()


def test_calls_at_once_or_one_after_the_other_are_all_made() -> None:
    for threads in (1, 2, None):
        done: list[int] = []
        at_once(*(partial(done.append, n) for n in range(3)), threads=threads)
        assert sorted(done) == [0, 1, 2]
