"""Settings as a TOML file: written beside a run's results, read back as options."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomli_w

from selective_depth.app.console.errors import UsageError
from selective_depth.app.settings import FLAT_SECTIONS, PlayOptions, Settings

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {
        "seeds": {"rows": 128, "columns": 128},
        "gas": {"nodes": 2800, "epochs": 50, "algorithm": "exact", "training": "cold"},
        "improvement": {"exponent": 1.9999, "formula": "eq27"},
    }
}
"""What `--preset` sets, by name: "paper" is section V's."""

SCHEMA = 1
"""Version of a settings file; a file without it was written before there were any."""
LARGEST_BYTES = 1 << 20
"""Settings files are smaller than this."""


def to_toml(settings: Settings, *heading: str) -> str:
    """Settings as TOML that `--settings` reads back, under a heading of comments.

    Where the results went, as ``save``, is not among the settings: another run with them must not
    replace these. How a recording was played is left out where it was just played, for a sensor is not.
    """
    tables = dataclasses.asdict(settings, dict_factory=_stated)
    for name in ("save", "save_model", "overwrite", "record", "json", "table"):
        tables["viewer"].pop(name, None)
    if settings.play == PlayOptions():
        tables["play"] = {}
    flat = {key: value for name in FLAT_SECTIONS for key, value in tables.pop(name).items()}
    told = "".join(f"# {_one_line(line)}\n" for line in heading)
    return told + tomli_w.dumps({"schema": SCHEMA} | flat | tables)


def _one_line(text: str) -> str:
    """A text as a comment may hold it: without line ends, control characters and broken UTF-8."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def _stated(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    """A table without what is None, which TOML does not have."""
    return {key: value for key, value in entries if value is not None}


def settings_arguments(path: Path, defaults: dict[str, Any]) -> list[str]:
    """Options of a TOML settings file, as the command line would give them.

    Each key is an option's name with underscores or dashes, each table its prefix:
    ``[gas]`` / ``nodes = 2000`` is ``--gas.nodes=2000``. So every check and every message
    of the command line holds for files too.

    Parameters
    ----------
    path : Path
        The file.
    defaults : dict
        The command's parameters with their defaults: they tell which options take no value, and
        which take several.

    Raises
    ------
    UsageError
        If the file cannot be read, is not TOML, or gives an option a value of the wrong kind.
    """
    flags, lists = (set(_options_like(defaults, kind)) for kind in (bool, tuple))
    arguments: list[str] = []
    for option, value in _flattened(_read(path), ""):
        name = option.rpartition(".")[2].removeprefix("--")
        if name == "save" and _is_of(path, Path(str(value))):
            continue  # written by an earlier version; this run is not to replace that recording
        if (name in flags) != isinstance(value, bool) or (isinstance(value, list) and name not in lists):
            kind = "true or false" if name in flags else "a single value, not true, false or a list"
            raise UsageError(f"{option} is {value!r} in '{path}'; it must be {kind}.")
        if isinstance(value, list):
            arguments += [option, *map(str, value)]
        elif value is True:
            arguments.append(option)
        elif value is not False:
            arguments.append(f"{option}={value}")
    return arguments


def preset_arguments(name: str, defaults: dict[str, Any]) -> list[str]:
    """Options of a preset, those that a command takes, as the command line would give them.

    Parameters
    ----------
    name : str
        One of `PRESETS`.
    defaults : dict
        The command's parameters with their defaults.

    Raises
    ------
    UsageError
        If there is no such preset, or the command has none of its options.
    """
    if name not in PRESETS:
        raise UsageError(f"--preset is '{name}'; it must be {' or '.join(PRESETS)}.")
    taken = {*defaults, *(key for value in defaults.values() for key in getattr(value, "__dict__", ()))}
    sections = {key: value for key, value in PRESETS[name].items() if key in taken}
    if not sections:
        raise UsageError(f"--preset {name} sets none of this command's options; leave it out.")
    return [f"{option}={value}" for option, value in _flattened(sections, "")]


def _is_of(settings: Path, saved: Path) -> bool:
    """Whether a settings file lies beside a recording, as of one run."""
    return settings.resolve() == (saved.parent / f"{saved.stem}.toml").resolve()


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            raise UsageError(f"settings file '{path}' is not a regular file; save it as one first.")
        with path.open("rb") as file:
            text = file.read(LARGEST_BYTES)
        if len(text) == LARGEST_BYTES:
            raise UsageError(f"settings file '{path}' is 1 MiB or more; settings take a few lines.")
        entries = tomllib.loads(text.decode())
        schema = entries.pop("schema", SCHEMA)
        if type(schema) is not int or schema > SCHEMA:
            raise UsageError(
                f"settings file '{path}' has schema {schema!r:.40}, but this version reads up to {SCHEMA};"
                " a later version wrote it."
            )
        return entries
    except FileNotFoundError:
        raise UsageError(
            f"settings file '{path}' does not exist. A run with --save writes one to start from."
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"settings file '{path}' cannot be read: {error}.") from None


def _flattened(table: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        option = f"{prefix}{key.replace('_', '-')}"
        if isinstance(value, dict):
            yield from _flattened(value, f"{option}.")
        else:
            yield f"--{option}", value


def _options_like(defaults: dict[str, Any], kind: type) -> Iterator[str]:
    """Names, without prefix, of the options whose default is of a kind."""
    for name, value in defaults.items():
        if dataclasses.is_dataclass(value):
            yield from _options_like(vars(value), kind)
        elif isinstance(value, kind):
            yield name.replace("_", "-")
