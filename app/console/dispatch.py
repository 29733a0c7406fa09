"""From a command line to its exit code: which command, how loud, and any error as one sentence."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from selective_depth.app.console import command, interrupt
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.console.exit_codes import FAILED, INTERRUPTED, MISUSED, OK

NARROWEST = 40
"""Columns; in fewer, the parser's help can take forever to find its line breaks."""


def run(arguments: Sequence[str], examples: Sequence[command.Example]) -> int:
    """Run a command line.

    Parameters
    ----------
    arguments : sequence of str
        What was typed after the program's name.
    examples : sequence of (str, str)
        Shown first in the program's own help.

    Returns
    -------
    int
        The exit code, out of `exit_codes`.
    """
    debug, verbose = "--debug" in arguments, "-v" in arguments or "--verbose" in arguments
    words = [word for word in arguments if word not in ("--debug", "-v", "--verbose")]
    try:
        with interrupt.recognised():
            return _dispatch(words, verbose, examples)
    except BrokenPipeError:  # whoever read the output has seen enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except KeyboardInterrupt:
        _say("interrupted.")
        return INTERRUPTED
    except Exception as error:  # the one place where any error becomes one line
        if debug:
            raise
        _say(sentence_of(error))
        return MISUSED if isinstance(error, UsageError) else FAILED


def _dispatch(words: list[str], verbose: bool, examples: Sequence[command.Example]) -> int:
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
    # The viewer's SDK logs in its own way to the terminal; its warnings are told in ours.
    os.environ.setdefault("RUST_LOG", "warn" if verbose else "off")
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    first, typed = (words or ["--help"])[0], words[1:]
    if first in ("-h", "--help", "help"):
        print(command.overview(examples))
    elif first == "--version":
        print(_versions())
    elif first == "--completion":
        print(command.completion(typed[0] if typed else ""))
    else:
        file = _value(typed, "--settings", "a file: --settings FILE.toml")
        preset = _value(typed, "--preset", "a name: --preset paper")
        settings = None if file is None else Path(file)
        given = {each: _value(typed, f"--{each}", "a value") for each in command.SOURCE_OPTIONS}
        call = command.parse_with_settings(command.find(first), typed, settings, preset)
        return command.with_source_options(call, {k: v for k, v in given.items() if v is not None})() or OK
    return OK


def _value(words: list[str], name: str, need: str) -> str | None:
    """Take an option's value out of a command line, None where the option is not in it."""
    for at, word in enumerate(words):
        if word.startswith(f"{name}="):
            return words.pop(at).partition("=")[2]
        if word == name:
            if at + 1 == len(words):
                raise UsageError(f"{name} needs {need}")
            return [words.pop(at), words.pop(at)][1]
    return None


def _versions() -> str:
    from selective_depth.app import __version__
    from selective_depth.drivers.errors import SourceError
    from selective_depth.drivers.openni import runtime_version

    try:
        runtime = f"OpenNI2 runtime {runtime_version()}"
    except SourceError as error:
        runtime = f"no OpenNI2 runtime: {error}"
    return f"{command.PROGRAM} {__version__}\n{runtime}"


def sentence_of(error: Exception) -> str:
    """An error in one sentence: its own where it is one of ours, else what kind it is."""
    from selective_depth.drivers.errors import SourceError

    words = " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        return "too many files are open at once. Raise the limit, as with 'ulimit -n 1024', and run it again."
    if isinstance(error, (AppError, SourceError, ValueError, OSError)) and words:
        return words
    return (
        f"unexpected {type(error).__name__}: {words or 'no message'}."
        " Run it again with --debug to see where, and please report it."
    )


def _say(words: str) -> None:
    with suppress(OSError):  # the terminal may be closed
        print(f"{command.PROGRAM}: {words}", file=sys.stderr)
