"""Options after the ``?`` of a source's name, taken one by one and checked."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.frame import MOST_PX

SMALLEST, LARGEST = 16, 4096
"""Bounds of a frame's width and height in pixels that `Options.size` accepts."""


def appended(uri: str, given: dict[str, str]) -> str:
    """A source's name with options after it, as `open_source` takes it."""
    more = "&".join(f"{name}={value}" for name, value in given.items())
    return f"{uri}{'&' if '?' in uri else '?'}{more}" if more else uri


def parted(uri: str) -> tuple[str, str]:
    """A source's name without its options, and these; what exists under the whole name has none."""
    try:
        name, _, options = (uri, "", "") if Path(uri).exists() else uri.partition("?")
        Path(name).exists()
    except (OSError, ValueError) as error:  # too long, or with a null byte
        raise SourceNotFoundError(f"'{uri:.60}…' cannot be the name of a file ({error!s:.40}…).") from None
    return name, options


_T = TypeVar("_T")


class Options:
    """The options of one source, ``key=value&key=value``.

    Each taking method names the option, its default and what is allowed; `done` then refuses
    whatever was given and not taken, so that a misspelt option is never silently ignored.

    Parameters
    ----------
    text : str
        What comes after the ``?``; may be empty.
    source : str
        Name of the source, for the messages.

    Raises
    ------
    SourceNotFoundError
        Here and in every method, if the text does not say what can be opened.
    """

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._given: dict[str, str] = {}
        self._known: list[str] = []
        for part in filter(None, text.split("&")):
            name, equals, value = part.partition("=")
            if not equals or not value:
                raise SourceNotFoundError(f"option '{part}' of {source} has no value; write name=value, with & between")
            if name in self._given:
                raise SourceNotFoundError(f"option '{name}' of {source} is given twice; keep one")
            self._given[name] = value

    def _taken(self, name: str, allowed: str, read: Callable[[str], _T], default: _T) -> _T:
        """What `read` makes of an option; it raises ValueError where that is not what is allowed."""
        self._known.append(f"{name} ({allowed})")
        value = self._given.pop(name, None)
        if value is None:
            return default
        try:
            return read(value)
        except ValueError:
            raise SourceNotFoundError(f"{name}={value} of {self._source}: give {allowed}") from None

    def choice(self, name: str, default: str, allowed: Sequence[str]) -> str:
        """One of the words `allowed`."""
        return self._taken(name, f"one of {', '.join(allowed)}", lambda value: _word(value, allowed), default)

    def choices(self, name: str, allowed: Sequence[str]) -> tuple[str, ...]:
        """Any of the words `allowed`, with + between; none by default."""
        words = f"any of {', '.join(allowed)}, with + between"
        return self._taken(name, words, lambda value: tuple(_word(each, allowed) for each in value.split("+")), ())

    def integer(self, name: str, default: int, low: int, high: int) -> int:
        """A whole number from `low` to `high`."""
        allowed = f"a whole number from {low} to {high}"
        return self._taken(name, allowed, lambda value: _whole(value, low, high), default)

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """A number from `low` to `high`."""
        allowed = f"a number from {low:g} to {high:g}"
        return self._taken(name, allowed, lambda value: _number(value, low, high), default)

    def change(self, name: str, allowed: Sequence[str]) -> tuple[str, int] | None:
        """One of the words `allowed` and a frame's number, written ``word@20``; None by default."""

        def read(value: str) -> tuple[str, int] | None:
            word, _, number = value.partition("@")
            return _word(word, allowed), _whole(number, 0, 99_999_999)

        words = f"one of {', '.join(allowed)}, @ and the number of a frame, such as {allowed[0]}@20"
        return self._taken(name, words, read, None)

    def numbers(self, name: str, what: str, low: float, high: float, between: str = ",") -> tuple[float, ...] | None:
        """Numbers from `low` to `high`, as many as `what` names; None if absent."""
        given = self.words_or_numbers(name, (), what, low, high, between)
        return given if isinstance(given, tuple) else None

    def words_or_numbers(
        self, name: str, words: Sequence[str], what: str, low: float, high: float, between: str = ","
    ) -> str | tuple[float, ...]:
        """One of the words, the first by default, or numbers from `low` to `high`, as many as `what` names."""
        count = len(re.split(between, what))

        def read(value: str) -> str | tuple[float, ...]:
            if value in words:
                return value
            numbers = tuple(_number(each, low, high) for each in re.split(between, value))
            if len(numbers) != count:
                raise ValueError(value)
            return numbers

        numbers = f"{what}, {'each ' * (count > 1)}a number from {low:g} to {high:g}"
        default: str | tuple[float, ...] = words[0] if words else ""
        return self._taken(name, f"{', '.join(words)}, or {numbers}" if words else numbers, read, default)

    def text(self, name: str, what: str) -> str:
        """Any text; empty if absent."""
        return self._taken(name, what, str, "")

    def scale(self) -> float | None:
        """The values per metre that were given for a source."""
        given = self.numbers("scale", "values per metre", 1e-2, 1e6)
        return given[0] if given else None

    def camera(self) -> tuple[float, ...] | None:
        """The intrinsics that were given for a source: fx, fy, cx, cy in pixels."""
        return self.numbers("camera", "fx,fy,cx,cy", -MOST_PX, MOST_PX)

    def size(self, name: str, default: tuple[int, int]) -> tuple[int, int]:
        """Width and height in pixels, written ``640x480``."""

        def read(value: str) -> tuple[int, int]:
            width, _, height = value.partition("x")
            return _whole(width, SMALLEST, LARGEST), _whole(height, SMALLEST, LARGEST)

        allowed = f"WIDTHxHEIGHT such as 640x480, each from {SMALLEST} to {LARGEST} pixels"
        return self._taken(name, allowed, read, default)

    def done(self) -> None:
        """Refuse what is left, naming what there is."""
        if self._given:
            unknown = ", ".join(f"'{name}'" for name in sorted(self._given))
            raise SourceNotFoundError(f"{self._source} has no option {unknown}; it has {', '.join(self._known)}")


def _word(text: str, allowed: Sequence[str]) -> str:
    if text not in allowed:
        raise ValueError(text)
    return text


def _whole(text: str, low: int, high: int) -> int:
    # isdecimal alone admits the digits of every script, which int() reads as well.
    if not (text.isascii() and text.isdecimal() and len(text) < 20 and low <= int(text) <= high):
        raise ValueError(text)
    return int(text)


def _number(text: str, low: float, high: float) -> float:
    number = float(text)
    if not low <= number <= high:  # NaN fails as well
        raise ValueError(text)
    return number
