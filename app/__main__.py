"""Entry point of the command `selective-depth`, and of `python -m selective_depth.app`.

What takes its time is imported when Ctrl-C is already taken care of.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NoReturn

from selective_depth.app import interrupt


def main() -> NoReturn:
    """Run the command line and end with its exit code."""
    interrupt.install()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - for good
    try:
        with interrupt.recognised():
            from selective_depth.app.cli import run
    except KeyboardInterrupt:
        print("selective-depth: interrupted.", file=sys.stderr)
        interrupt.leave()
    code = run(sys.argv[1:])
    if code == interrupt.EXIT_CODE:
        interrupt.leave()
    sys.exit(code)


if __name__ == "__main__":
    main()
