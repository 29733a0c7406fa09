"""Runs commands on a disk that fills: a script that forks for each, since importing takes longer than most of them.

Reads JSON lines ``[limit or null, [word, …]]`` and answers each with ``[exit code, what it printed]``.
No file can grow beyond the limit in bytes.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile

import matplotlib.backends.backend_agg
import matplotlib.backends.backend_pdf  # noqa: F401 - imported once, for all children
import numba  # noqa: F401
import pyarrow.parquet  # noqa: F401
import rosbags.highlevel
import rosbags.rosbag2  # noqa: F401

from selective_depth.app import cli, cli_compare  # noqa: F401
from selective_depth.app.commands import figures, files, model, snapshot  # noqa: F401
from selective_depth.app.evaluation import evaluate  # noqa: F401
from selective_depth.drivers import folder, oni, virtual  # noqa: F401
from selective_depth.selectors import acquire, improvement, neural_gas  # noqa: F401


def run(limit: int | None, words: list[str]) -> tuple[int, str]:
    """A command in a child; what it printed goes where no limit holds, through a pipe."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.dup2(writing, 1)
        os.dup2(writing, 2)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        code = 70
        try:
            code = cli.run(words)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading, errors="replace") as printed:
        text = printed.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text


if __name__ == "__main__":
    tempfile.tempdir = os.environ.get("TMPDIR")
    for line in sys.stdin:
        print(json.dumps(run(*json.loads(line))), flush=True)
