"""Single keys of the terminal while a run goes on; off where there is no terminal."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from selective_depth.app.console import interrupt

KEYS = """\
+ - budget   [ ] rounds   s selector   m memory   l layout   x reset   q quit
space pause   r record   p picture"""
"""What the keys do."""
_LOOK_S = 0.2


@contextmanager
def pressed(act: Callable[[str], None]) -> Iterator[bool]:
    """Call `act` with every key that is pressed meanwhile; yields whether there are keys.

    Keys need a terminal as input and for messages, in the foreground, and POSIX: Windows' consoles
    have another way, which is not built.
    """
    try:
        import termios
        import tty

        terminal = sys.stdin.fileno()
        there = sys.stdin.isatty() and sys.stderr.isatty() and os.tcgetpgrp(terminal) == os.getpgrp()
        before = termios.tcgetattr(terminal) if there else None
    except (ImportError, OSError, ValueError, AttributeError):
        before = None
    if before is None:
        yield False
        return
    over = threading.Event()

    def listen() -> None:
        while not over.is_set():
            if select.select([terminal], [], [], _LOOK_S)[0]:
                key = os.read(terminal, 1)
                if not key:
                    return  # the terminal is gone
                act(key.decode("ascii", "replace"))

    def restore() -> None:
        with suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)

    thread = threading.Thread(target=listen, name="keys", daemon=True)
    tty.setcbreak(terminal)
    interrupt.before_leaving = restore
    thread.start()
    try:
        yield True
    finally:
        over.set()
        thread.join(2 * _LOOK_S)
        restore()
        interrupt.before_leaving = None
