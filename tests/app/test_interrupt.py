"""Ctrl-C is known for what it is, whatever error it comes out as."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest

from selective_depth.app import cli
from selective_depth.app.console import interrupt
from selective_depth.app.pipeline import Pipeline


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
    monkeypatch.setattr(Pipeline, "_gas_of", interrupted)
    arguments = ["replay", "virtual:ball?size=64x48&frames=9", "--headless"]
    assert cli.run([*arguments, "--seeds.rows", "16", "--seeds.columns", "16"]) == 130
    shown = capsys.readouterr()
    assert "SystemError" not in shown.err
    assert "whole loop" in shown.out


def run(program: str, meanwhile: Callable[[subprocess.Popen[str]], None]) -> tuple[int, str, str]:
    """Run a program, do something once it has said a line, and return its code and what it said."""
    lines = f"from selective_depth.app.console import interrupt\ninterrupt.install()\n{program}"
    with subprocess.Popen(
        [sys.executable, "-c", lines], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        meanwhile(process)
        assert process.stderr is not None
        out, err = process.stdout.read(), process.stderr.read()
    return process.returncode, out, err


STUBBORN = """
import time
word = "ready"
while True:
    try:
        if word:
            print(word, flush=True)
        word = ""
        time.sleep(60)
    except KeyboardInterrupt:
        pass
"""


NOT_PYTHON = """
import hashlib
print("ready", flush=True)
hashlib.pbkdf2_hmac("sha256", b"", b"", 100_000_000)  # takes a minute and looks at no signal
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals between processes are POSIX's")
@pytest.mark.parametrize(("program", "number"), [(STUBBORN, signal.SIGINT), (NOT_PYTHON, signal.SIGTERM)])
def test_what_ignores_ctrl_c_is_ended_by_the_watchdog(program: str, number: signal.Signals) -> None:
    def interrupt_it(process: subprocess.Popen[str]) -> None:
        time.sleep(0.5)  # it has said that it is ready, and goes on to its call
        process.send_signal(number)

    start_s = time.monotonic()
    code, _, _ = run(program, interrupt_it)
    assert code == 130
    assert time.monotonic() - start_s < interrupt.LEAVE_S + 2


@pytest.mark.skipif(sys.platform == "win32", reason="signals between processes are POSIX's")
def test_ctrl_c_lost_in_a_destructor_is_raised_by_the_next_check_and_says_nothing() -> None:
    program = """
import time
class Slow:
    def __del__(self):
        print("ready", flush=True)
        time.sleep(60)
slow = Slow()
del slow
try:
    interrupt.check()
except KeyboardInterrupt:
    print("raised")
"""
    code, out, err = run(program, lambda process: process.send_signal(signal.SIGINT))
    assert (code, out, err) == (0, "raised\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="signals between processes are POSIX's")
def test_what_must_not_be_left_half_done_is_done_before_ctrl_c_is_raised() -> None:
    program = """
import time
try:
    with interrupt.deferred():
        print("ready", flush=True)
        time.sleep(0.5)
        print("done", flush=True)
    print("not reached", flush=True)
except KeyboardInterrupt:
    print("raised", flush=True)
"""
    code, out, _ = run(program, lambda process: process.send_signal(signal.SIGINT))
    assert (code, out) == (0, "done\nraised\n")
