"""Compiling in a process beside: it ends with what it was to help, however that ends."""

from __future__ import annotations

import subprocess
import time

import pytest

from selective_depth.app.pipeline import warm_up as precompile


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """Every process started beside, with no patience at all."""
    found: list[subprocess.Popen[bytes]] = []

    class Recorded(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, *args: object, **options: object) -> None:
            super().__init__(*args, **options)  # type: ignore[call-overload]
            found.append(self)

    monkeypatch.setattr(precompile.subprocess, "Popen", Recorded)
    monkeypatch.setattr(precompile, "PATIENCE_S", 0.0)
    return found


def test_it_is_waited_for_and_does_its_work(started: list[subprocess.Popen[bytes]]) -> None:
    with precompile.compiling_beside():
        time.sleep(0.2)
    assert [process.returncode for process in started] == [0]


def test_a_first_run_does_not_wait_for_help(
    started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "PATIENCE_S", 60.0)
    monkeypatch.setattr(precompile, "kept_share", lambda: 0.0)
    with precompile.compiling_beside():
        time.sleep(0.2)
    assert len(started) == 1


def test_nothing_is_left_after_an_error(started: list[subprocess.Popen[bytes]]) -> None:
    with pytest.raises(KeyboardInterrupt), precompile.compiling_beside():
        time.sleep(0.2)
        raise KeyboardInterrupt
    assert len(started) == 1
    assert started[0].returncode != 0


def test_warm_kernels_need_no_help(started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "PATIENCE_S", 60.0)
    monkeypatch.setattr(precompile, "kept_share", lambda: 1.0)
    with precompile.compiling_beside():
        pass
    assert started == []
