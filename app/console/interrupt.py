"""Ctrl-C that always works, within three seconds and whatever is going on.

Python raises KeyboardInterrupt wherever it happens to be, and loses it where nothing may be
raised: in a callback of an import, in a destructor; in a call of a compiled function it becomes a
SystemError. So it is noted as well, for the loop to look at and for errors to be known by. In a
call of anything that is not Python it waits until that returns; so, if all else fails, a watchdog
ends the program.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from selective_depth.app.console.exit_codes import INTERRUPTED

LEAVE_S = 2.8
"""How long after Ctrl-C the program is gone at the latest."""
SAVE_S = 15.0
"""The same while a recording is being written, which must not be cut off."""

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""What ends a run in good order; Windows has no SIGHUP."""

before_leaving: Callable[[], None] | None = None
"""What has to be put in order even where the program is ended at once: a terminal's mode."""
patience_s = LEAVE_S
"""How long what is going on may take to end."""

_asked = threading.Event()
_deferring = False


def install() -> None:
    """Take Ctrl-C; the system's request to end and a closed terminal are treated alike."""
    for number in SIGNALS:
        # What `nohup` has made deaf to its terminal's end stays so.
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _on_signal)
    import socket  # it takes its time: Ctrl-C is taken already

    told, tells = socket.socketpair()
    tells.setblocking(False)
    signal.set_wakeup_fd(tells.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(told.recv,), name="watchdog", daemon=True).start()
    # It may come where Python can only report that it was raised and lost; `check` raises it again.
    sys.unraisablehook = _unless_interrupted
    # The program ends without its destructors. What processes shared is then cleared away by
    # Python's tracker of such things, which need not warn of it.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")


def check() -> None:
    """Raise the KeyboardInterrupt that was asked for, should it have been lost."""
    if _asked.is_set():
        raise KeyboardInterrupt


@contextmanager
def recognised() -> Iterator[None]:
    """Raise KeyboardInterrupt in place of any error that comes after Ctrl-C."""
    try:
        yield
    except Exception:
        check()
        raise


@contextmanager
def deferred() -> Iterator[None]:
    """Let what happens inside, which must leave nothing half done, end before Ctrl-C is raised."""
    global _deferring
    _deferring = True
    try:
        yield
    finally:
        _deferring = False
    check()


@contextmanager
def started_deaf() -> Iterator[None]:
    """Let processes that start meanwhile be deaf to Ctrl-C from their first moment.

    It goes to all processes of a terminal; their parent says what becomes of it.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _unless_interrupted(lost: sys.UnraisableHookArgs) -> None:
    if not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)


def _watch(receive: Callable[[int], bytes]) -> None:
    """End the program when it has had its time.

    The system tells a socket of a signal at once, `_on_signal` only when Python is running again.
    """
    while receive(1)[0] not in SIGNALS:
        pass
    time.sleep(patience_s)
    if before_leaving is not None:
        before_leaving()
    os._exit(INTERRUPTED)


def _on_signal(number: int, frame: object) -> None:
    _asked.set()
    if not _deferring:
        raise KeyboardInterrupt
