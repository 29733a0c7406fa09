"""Entry point of the command `selective-depth`, and of `python -m selective_depth.app`.

What takes its time is imported when Ctrl-C is already taken care of.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from selective_depth.app.console import interrupt
from selective_depth.app.console.exit_codes import INTERRUPTED


def main() -> NoReturn:
    """Run the command line and end with its exit code."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - for good
    try:
        with interrupt.recognised():
            interrupt.install()
            from selective_depth.app.cli import run
    except KeyboardInterrupt:
        _say("interrupted.")
        _leave(INTERRUPTED)
    _leave(run(sys.argv[1:]))


def _leave(code: int) -> NoReturn:
    """End at once, with all output said; everything is closed by now.

    Python's own way out takes apart what it has imported, a third of a second in which Ctrl-C is
    not ours; and what an import or a compiler was in the middle of could hold it up for longer.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read the output has seen enough, as in `| head`
        code = code or 1
    except OSError as error:
        _say(f"the output cannot be written: {error.strerror}.")
        code = code or 1
    with suppress(OSError):  # there is nowhere to say it
        sys.stderr.flush()
    os._exit(code)


def _say(words: str) -> None:
    with suppress(OSError):
        print(f"selective-depth: {words}", file=sys.stderr)


if __name__ == "__main__":
    main()
