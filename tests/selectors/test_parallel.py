"""Bands of rows: every row once, and no band outlives the call."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.selectors.parallel import default_threads, in_bands


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
