"""One typed function is one command: how commands are listed, parsed and refused.

A command is added in `cli.py`, nowhere else::

    @command("Files", ("selective-depth check walk.oni", "what is wrong with it, and where"))
    def check(file: Annotated[Path, arg(metavar="FILE")], /) -> int | None:
        \"\"\"Say whether a recording is whole.

        Parameters
        ----------
        file : Path
            The recording.
        \"\"\"
        from selective_depth.drivers.oni.inspection import inspect_oni  # heavy: after parsing
        ...

Its signature is its command line (tyro); what it returns is the exit code, None being 0.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import io
import re
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from selective_depth.app.console.errors import UsageError

PROGRAM = "selective-depth"
SHELLS = ("bash", "zsh")
Run = Callable[..., int | None]
Example = tuple[str, str]


@dataclass(frozen=True)
class Command:
    """A command as it was declared.

    Parameters
    ----------
    run : callable
        The function; its signature is the command line.
    group : str
        The heading under which it is listed.
    examples : tuple of (str, str)
        Command lines, each with what it does; they come first in the help.
    """

    run: Run
    group: str
    examples: tuple[Example, ...]

    @property
    def name(self) -> str:
        """What is typed: the function's name, without underscores."""
        return self.run.__name__.strip("_").replace("_", "-")

    @property
    def summary(self) -> str:
        """First line of the function's docstring."""
        return (inspect.getdoc(self.run) or "").partition("\n")[0]

    @property
    def description(self) -> str:
        """Summary, examples, and the rest of the docstring but for its parameters."""
        text = (inspect.getdoc(self.run) or "").partition("\nParameters\n")[0]
        summary, _, rest = text.partition("\n")
        return "\n".join(
            [summary, "", "Examples:", *_example_lines(self.examples), *rest.rstrip().split("\n")]
        )


COMMANDS: dict[str, Command] = {}


def command(group: str, *examples: Example) -> Callable[[Run], Run]:
    """Declare a function as a command of the program, in a group, with examples."""

    def declare(run: Run) -> Run:
        made = Command(run, group, examples)
        COMMANDS[made.name] = made
        return run

    return declare


def _example_lines(examples: Sequence[Example]) -> list[str]:
    width = max((len(line) for line, _ in examples), default=0)
    if width > 60:
        return [part for line, what in examples for part in (f"  {line}", f"      {what}")]
    return [f"  {line:{width}}  {what}" for line, what in examples]


def overview(examples: Sequence[Example]) -> str:
    """Text of `selective-depth --help`: examples first, then the commands by group."""
    lines = ["Measure depth where it counts: selective acquisition for Kinect-class sensors."]
    lines += ["", "Examples:", *_example_lines(examples)]
    width = max(map(len, COMMANDS))
    for group in dict.fromkeys(each.group for each in COMMANDS.values()):
        lines += ["", f"{group}:"]
        members = [each for each in COMMANDS.values() if each.group == group]
        lines += [f"  {each.name:{width}}  {each.summary}" for each in members]
    lines += [
        "",
        f"'{PROGRAM} COMMAND --help' tells all about a command. With any command:",
        "  -v, --verbose        say more",
        "  --debug              show the traceback of an error",
        "  --settings FILE      take options from a TOML file; the command line wins",
        "Alone:",
        "  --version            versions of this program and of the OpenNI2 runtime found",
        f"  --completion SHELL   print a completion script for {', '.join(SHELLS)}",
    ]
    return "\n".join(lines)


def find(name: str) -> Command:
    """Return the command of a name, or say which one was probably meant."""
    if name in COMMANDS:
        return COMMANDS[name]
    close = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"Did you mean '{close[0]}'?" if close else f"There are: {', '.join(COMMANDS)}."
    raise UsageError(f"'{name}' is no command. {hint} '{PROGRAM} --help' shows examples.")


def invoke(name: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of a command and run it.

    Parameters
    ----------
    name : str
        The command.
    arguments : sequence of str
        What was typed after it.

    Returns
    -------
    int
        Its exit code.

    Raises
    ------
    UsageError
        If the arguments are not what the command's signature asks for.
    """
    chosen = find(name)
    call = parse(chosen, arguments)
    return call() or 0


def parse(chosen: Command, arguments: Sequence[str]) -> Callable[[], int | None]:
    """Return a command's call with its arguments, without running it.

    Raises
    ------
    UsageError
        As for `invoke`.
    """
    import tyro

    received: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    # The function itself runs outside the parser, so that its own output and errors are
    # not mistaken for the parser's.
    def receive(*args: Any, **kwargs: Any) -> None:
        received.append((args, kwargs))

    receive.__signature__ = inspect.signature(chosen.run)  # type: ignore[attr-defined]
    receive.__annotations__ = chosen.run.__annotations__
    receive.__doc__ = chosen.run.__doc__
    receive.__module__ = chosen.run.__module__
    receive.__wrapped__ = chosen.run  # type: ignore[attr-defined]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            tyro.cli(
                receive,
                prog=f"{PROGRAM} {chosen.name}",
                description=chosen.description,
                args=list(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code == 0 or stop.code is None:
            raise
        raise UsageError(_one_line(complaint.getvalue(), chosen.name)) from None
    args, kwargs = received[0]
    return lambda: chosen.run(*args, **kwargs)


def _one_line(boxed: str, name: str) -> str:
    """What the parser drew as a box, as one sentence."""
    body = boxed.partition("For full helptext")[0].replace("(required)", "")
    words = " ".join(re.sub(r"╭.*╮|╰.*╯|[│─]", " ", body).split())
    # Of a value of the wrong type the parser tells how it tried each type; the first line is it.
    words = re.sub(
        r"^Error parsing (\S+):.* instantiated from \['(.*?)'\]\..*",
        r"\1 is '\2', which is no value for it",
        words.partition(" Argument helptext:")[0],
    )
    words = re.sub(rf"^Missing from {PROGRAM} {name}: ", "missing: ", words)
    return f"{words.rstrip('.')}. '{PROGRAM} {name} --help' shows what it takes."


def settings_arguments(path: Path) -> list[str]:
    """Options of a TOML settings file, as the command line would give them.

    Each key is an option's name with underscores or dashes, each table its prefix:
    ``[gas]`` / ``nodes = 2000`` is ``--gas.nodes 2000``. So every check and every message
    of the command line holds for files too.

    Raises
    ------
    UsageError
        If the file cannot be read or is no TOML.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(
            f"settings file '{path}' does not exist. A run with --save writes one to start from."
        ) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"settings file '{path}' cannot be read: {error}.") from None
    return list(_flatten(table, ""))


def _flatten(table: dict[str, Any], prefix: str) -> list[str]:
    arguments: list[str] = []
    for key, value in table.items():
        option = f"--{prefix}{key.replace('_', '-')}"
        if isinstance(value, dict):
            arguments += _flatten(value, f"{prefix}{key.replace('_', '-')}.")
        elif value is True:
            arguments.append(option)
        elif isinstance(value, list):
            arguments += [option, *map(str, value)]
        elif value is not False:
            arguments += [option, str(value)]
    return arguments


def completion(shell: str) -> str:
    """Shell script that completes every command and option.

    Raises
    ------
    UsageError
        If the shell is not one of `SHELLS`.
    """
    if shell not in SHELLS:
        raise UsageError(f"no completion for '{shell}'. There is one for: {', '.join(SHELLS)}.")
    import tyro

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            {each.name: each.run for each in COMMANDS.values()},
            prog=PROGRAM,
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    return script.getvalue()


def colours() -> bool:
    """Whether standard output is a terminal that takes colours."""
    return sys.stdout.isatty()
