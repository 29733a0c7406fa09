"""Ctrl-C is known for what it is, whatever error it comes out as."""

from __future__ import annotations

import threading

import pytest

from selective_depth.app import cli, interrupt
from selective_depth.app.loop import Loop


def fail(*_: object) -> None:
    raise SystemError("returned a result with an exception set")  # so numba loses Ctrl-C


def test_an_error_is_ctrl_c_after_ctrl_c_only(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = threading.Event()
    monkeypatch.setattr(interrupt, "_asked", asked)
    with pytest.raises(SystemError), interrupt.recognised():
        fail()
    asked.set()
    with pytest.raises(KeyboardInterrupt), interrupt.recognised():
        fail()


def test_a_run_interrupted_in_a_compiled_function_ends_as_any_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = threading.Event()

    def interrupted(*_: object) -> None:
        asked.set()
        fail()

    monkeypatch.setattr(interrupt, "_asked", asked)
    monkeypatch.setattr(Loop, "_regions", interrupted)
    arguments = ["replay", "virtual:ball?size=64x48&frames=9", "--headless"]
    assert cli.run([*arguments, "--seeds.rows", "16", "--seeds.columns", "16"]) == 130
    shown = capsys.readouterr()
    assert "SystemError" not in shown.err
    assert "whole loop" in shown.out
