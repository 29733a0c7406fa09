"""One typed function is one command: how commands are listed, parsed and refused.

A command is added in `cli.py`, nowhere else::

    @command("Files")
    def check(file: Annotated[Path, arg(metavar="FILE")], /) -> int | None:
        \"\"\"Say whether a recording is whole.

        Parameters
        ----------
        file : Path
            The recording.

        Examples
        --------
        selective-depth check walk.oni
            what is wrong with it, and where
        \"\"\"
        from selective_depth.drivers.oni.inspection import inspect_oni  # heavy: after parsing
        ...

Its signature is its command line (tyro); what it returns is the exit code, None being 0.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import inspect
import io
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Annotated, Any

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.settings_file import preset_arguments, settings_arguments

PROGRAM = "selective-depth"
SHELLS = ("bash", "zsh", "fish")
SOURCE_OPTIONS = {
    "scale": ("N", "values per metre of a folder's images, as 1000 or 5000"),
    "camera": ("FX,FY,CX,CY", "intrinsics in pixels"),
    "mode": ("640x480@30", "of a sensor"),
    "topic": ("NAME", "of a ROS bag"),
    "stream": ("N", "which depth stream of an .oni file, from 1"),
    "colour": ("WORD", "off; registered or unregistered, as it lies on depth; or the colour camera as"
               " FX,FY,CX,CY,X,Y,Z, its place in mm beside that of depth"),
}  # fmt: skip
"""Options of sources, which every command that opens one takes as ``--NAME VALUE``: what the value is, and means."""
_OPTIONS = {
    "settings": ("FILE", "take options from a TOML file; the command line wins"),
    "preset": ("paper", "take the options that the paper's section V was made with"),
}
_SWITCHES = {"verbose": "say more", "debug": "show the traceback of an error"}
"""What every command takes."""
SOURCES = ("source", "sources", "device", "paths")
"""Parameters of commands that name what `open_source` opens; the last of the paths is where it goes."""
FISH_FILES = f"""
complete --command {PROGRAM} --force-files --condition 'set -l typed (commandline -opc); \
test (count $typed) -gt 1; and not string match -q -- "-*" $typed[-1] (commandline -ct)'
"""
"""Files are what a command takes but for its options: fish is told none by the parser."""
Run = Callable[..., int | None]
Call = functools.partial[int | None]
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
    """

    run: Run
    group: str

    @property
    def name(self) -> str:
        """What is typed: the function's name, without underscores."""
        return self.run.__name__.strip("_").replace("_", "-")

    @property
    def summary(self) -> str:
        """First line of the function's docstring."""
        return self._sections[0].partition("\n")[0]

    @property
    def examples(self) -> list[Example]:
        """Command lines, each with what it does: the last section of the function's docstring."""
        lines = [line.strip() for line in self._sections[-1].splitlines()]
        return list(zip(lines[::2], lines[1::2], strict=True))

    @property
    def _sections(self) -> list[str]:
        """The docstring's text, its parameters, its examples."""
        return re.split(r"\n(?:Parameters|Examples)\n-+\n", inspect.getdoc(self.run) or "")

    @property
    def description(self) -> str:
        """Summary, examples, and the rest of the docstring but for its parameters."""
        summary, _, rest = self._sections[0].partition("\n")
        lines = [summary, "", "Examples:", *_example_lines(self.examples), *rest.rstrip().split("\n")]
        if set(SOURCES) & set(inspect.signature(self.run).parameters):
            lines += ["", *_source_help()]
        return "\n".join(lines)


COMMANDS: dict[str, Command] = {}


def command(group: str) -> Callable[[Run], Run]:
    """Declare a function as a command of the program, in a group."""

    def declare(run: Run) -> Run:
        made = Command(run, group)
        COMMANDS[made.name] = made
        return run

    return declare


def _example_lines(examples: Sequence[Example]) -> list[str]:
    width = max((len(line) for line, _ in examples), default=0)
    if width > 60:
        return [part for line, what in examples for part in (f"  {line}", f"      {what}")]
    return [f"  {line:{width}}  {what}" for line, what in examples]


def _source_help() -> list[str]:
    lines = ["With any command that takes a SOURCE or DEVICE, for what the source itself does not tell:"]
    for name, (value, told) in SOURCE_OPTIONS.items():
        first = f"  --{name} {value}".ljust(23)
        lines += textwrap.wrap(told, 97, initial_indent=f"{first} " if len(first) > 23 else first,
                               subsequent_indent=" " * 23)  # fmt: skip
    return lines


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
        *(f"  {'-v, ' * (name == 'verbose')}--{name}".ljust(23) + told for name, told in _SWITCHES.items()),
        *(f"  --{name} {value}".ljust(23) + told for name, (value, told) in _OPTIONS.items()),
        *_source_help(),
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
    raise UsageError(f"there is no command '{name}'. {hint} '{PROGRAM} --help' shows examples.")


def parse(chosen: Command, arguments: Sequence[str]) -> Call:
    """Return a command's call with what was typed after its name, without running it.

    Raises
    ------
    UsageError
        If the arguments are not what the command's signature asks for.
    """
    import tyro

    # The parser gets a call for a result. Run inside it, a command's own output and errors would
    # be mistaken for the parser's.
    @functools.wraps(chosen.run)
    def bound(*args: Any, **kwargs: Any) -> Any:
        return functools.partial(chosen.run, *args, **kwargs)

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            call: Call = tyro.cli(
                bound,
                prog=f"{PROGRAM} {chosen.name}",
                description=chosen.description,
                args=list(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(_one_line(complaint.getvalue(), chosen.name)) from None
    return call


def parse_with_settings(chosen: Command, arguments: Sequence[str], file: Path | None, preset: str | None) -> Call:
    """As `parse`, with the options of a settings file, else of a preset, where none are typed.

    Raises
    ------
    UsageError
        As for `parse`; names the file if what is wrong stands there.
    """
    parameters = inspect.signature(chosen.run).parameters
    defaults = {name: each.default for name, each in parameters.items()}
    # Before what was typed, so that what was typed wins.
    arguments = [*(preset_arguments(preset, defaults) if preset else ()), *arguments]
    if file is None:
        return parse(chosen, arguments)
    try:
        return parse(chosen, [*settings_arguments(file, defaults), *arguments])
    except UsageError as error:
        parse(chosen, arguments)  # or is it what was typed that is wrong?
        raise UsageError(f"{error} That option stands in '{file}'.") from None


def with_source_options(call: Call, given: dict[str, str]) -> Call:
    """A parsed call whose sources, or sensor, have these options after their names.

    Raises
    ------
    UsageError
        If the command takes none.
    """
    if not given:
        return call
    bound = inspect.signature(call.func).bind(*call.args, **call.keywords)
    bound.apply_defaults()
    names = [name for name in SOURCES if bound.arguments.get(name) is not None]
    if not names:
        raise UsageError(f"--{next(iter(given))} is an option of a source, and none is named.")
    from selective_depth.drivers.options import appended

    for name in names:
        value = bound.arguments[name]
        if isinstance(value, str):
            bound.arguments[name] = appended(value, given)
        else:
            end = len(value) - (name == "paths")
            bound.arguments[name] = (*(appended(each, given) for each in value[:end]), *value[end:])
    return functools.partial(call.func, *bound.args, **bound.kwargs)


def _one_line(boxed: str, name: str) -> str:
    """What the parser drew as a box under a title, as one sentence."""
    lines = [re.sub("[╭╮╰╯│─]", "", line).strip() for line in boxed.splitlines()]
    words = " ".join([line for line in lines if line.strip("-")][1:])
    words = re.split(r" (?:Argument|For full) helptext", words)[0].replace("(required)", "")
    if name == "replay":
        one = r"'replay' takes one source, and '\1' is another; 'batch' takes several"
        words = re.sub(r"^Unrecognized options: ([^- ]\S*).*", one, words)
    for parsers, ours in (
        (r"^Error parsing (\S+): is ", r"\1 is "),  # the rest is ours already, of settings.py
        # Of a value of the wrong type it tells how it tried each type.
        (r"^Error parsing (\S+):.* instantiated from \['(.*?)'\]\..*", r"\1 cannot be '\2'"),
        (r"^Missing value for argument '(\S+)'.*", r"\1 needs a value"),
        (r"^Unrecognized options: (.*?) Perhaps you meant: (\S+).*", r"\1: did you mean \2?"),
        (r"^Unrecognized options: ", f"'{name}' does not take "),
        (rf"^Missing from {PROGRAM} {name}: ", "missing: "),
    ):
        words = re.sub(parsers, ours, words)
    stop = "" if words.endswith("?") else "."
    return f"{words.rstrip('. ')}{stop} '{PROGRAM} {name} --help' shows what it takes."


def completion(shell: str) -> str:
    """Shell script that completes every command, every option and the names of files.

    Raises
    ------
    UsageError
        If the shell is not one of `SHELLS`.
    """
    if shell not in SHELLS:
        known = f"{', '.join(SHELLS[:-1])} and {SHELLS[-1]}"
        raise UsageError(f"completion is there for {known}, not for '{shell}'.")
    import tyro

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            {each.name: _with_all_options(each) for each in COMMANDS.values()},
            prog=PROGRAM,
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    # Fish takes each line of a description for a completion of its own.
    completed = re.sub(
        "^COMPLETION_SPEC = .*", lambda spec: re.sub(r"\\+n", " ", spec[0]), script.getvalue(), flags=re.M
    )
    return completed + FISH_FILES * (shell == "fish")


def _with_all_options(chosen: Command) -> Run:
    """A command's function that takes the options, too, which others take out of a command line before it is parsed."""
    import tyro

    def run(*args: Any, **kwargs: Any) -> None: ...

    own = inspect.signature(chosen.run, eval_str=True)
    valued = _OPTIONS | (SOURCE_OPTIONS if set(SOURCES) & set(own.parameters) else {})
    fields: list[tuple[str, Any, Any]] = [
        (name, Annotated[str, tyro.conf.arg(metavar=value, help=told)], "") for name, (value, told) in valued.items()
    ]
    fields += [(name, Annotated[bool, tyro.conf.arg(help=told)], False) for name, told in _SWITCHES.items()]
    more = make_dataclass("More", fields)
    taken = inspect.Parameter("more", inspect.Parameter.KEYWORD_ONLY, default=more(),
                              annotation=Annotated[more, tyro.conf.arg(name="")])  # fmt: skip
    parameters = [*own.parameters.values(), taken]
    run.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__doc__ = chosen.run.__doc__
    return run
