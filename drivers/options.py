"""Options after the ``?`` of a source's name, taken one by one and checked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

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

    def _take(self, name: str, allowed: str) -> str | None:
        self._known.append(f"{name} ({allowed})")
        return self._given.pop(name, None)

    def _refuse(self, name: str, value: str, allowed: str) -> SourceNotFoundError:
        return SourceNotFoundError(f"{name}={value} of {self._source}: give {allowed}")

    def choice(self, name: str, default: str, allowed: Sequence[str]) -> str:
        """One of the words `allowed`."""
        words = ", ".join(allowed)
        value = self._take(name, words)
        if value is None:
            return default
        if value not in allowed:
            raise self._refuse(name, value, f"one of {words}")
        return value

    def choices(self, name: str, allowed: Sequence[str]) -> tuple[str, ...]:
        """Any of the words `allowed`, with + between; none by default."""
        words = f"any of {', '.join(allowed)}, with + between"
        value = self._take(name, words)
        chosen = tuple(value.split("+")) if value else ()
        if value and not set(chosen) <= set(allowed):
            raise self._refuse(name, value, words)
        return chosen

    def integer(self, name: str, default: int, low: int, high: int) -> int:
        """A whole number from `low` to `high`."""
        allowed = f"a whole number from {low} to {high}"
        value = self._take(name, allowed)
        if value is None:
            return default
        # isdecimal alone admits the digits of every script, which int() reads as well.
        if not (value.isascii() and value.isdecimal() and len(value) < 20):
            raise self._refuse(name, value, allowed)
        if not low <= int(value) <= high:
            raise self._refuse(name, value, allowed)
        return int(value)

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """A number from `low` to `high`."""
        allowed = f"a number from {low:g} to {high:g}"
        value = self._take(name, allowed)
        if value is None:
            return default
        try:
            number = float(value)
        except ValueError:
            raise self._refuse(name, value, allowed) from None
        if not low <= number <= high:  # NaN fails as well
            raise self._refuse(name, value, allowed)
        return number

    def change(self, name: str, allowed: Sequence[str]) -> tuple[str, int] | None:
        """One of the words `allowed` and a frame's number, written ``word@20``; None by default."""
        words = f"one of {', '.join(allowed)}, @ and the number of a frame, such as {allowed[0]}@20"
        value = self._take(name, words)
        if value is None:
            return None
        word, _, number = value.partition("@")
        if word not in allowed or not (number.isascii() and number.isdecimal() and len(number) < 9):
            raise self._refuse(name, value, words)
        return word, int(number)

    def numbers(
        self, name: str, what: str, low: float, high: float, between: str = ",", *, words: str = ""
    ) -> tuple[float, ...] | None:
        """Numbers from `low` to `high`, as many as `what` names; None if absent. `words` may be given as well."""
        count = len(re.split(between, what))
        allowed = f"{words}{what}, {'each ' * (count > 1)}a number from {low:g} to {high:g}"
        value = self._take(name, allowed)
        if value is None:
            return None
        try:
            numbers = tuple(float(word) for word in re.split(between, value))
        except ValueError:
            raise self._refuse(name, value, allowed) from None
        if len(numbers) != count or not all(low <= number <= high for number in numbers):
            raise self._refuse(name, value, allowed)
        return numbers

    def words_or_numbers(
        self, name: str, words: Sequence[str], what: str, low: float, high: float
    ) -> str | tuple[float, ...]:
        """One of the words, the first by default, or numbers as `numbers` takes them."""
        if self._given.get(name, words[0]) in words:
            return self.choice(name, words[0], words)
        return self.numbers(name, what, low, high, words=f"{', '.join(words)}, or ") or ""

    def text(self, name: str, what: str) -> str:
        """Any text; empty if absent."""
        return self._take(name, what) or ""

    def scale(self) -> float | None:
        """The values per metre that were given for a source."""
        given = self.numbers("scale", "values per metre", 1e-2, 1e6)
        return given[0] if given else None

    def camera(self) -> tuple[float, ...] | None:
        """The intrinsics that were given for a source: fx, fy, cx, cy in pixels."""
        return self.numbers("camera", "fx,fy,cx,cy", -MOST_PX, MOST_PX)

    def size(self, name: str, default: tuple[int, int]) -> tuple[int, int]:
        """Width and height in pixels, written ``640x480``."""
        allowed = f"WIDTHxHEIGHT such as 640x480, each from {SMALLEST} to {LARGEST} pixels"
        value = self._take(name, allowed)
        if value is None:
            return default
        width, _, height = value.partition("x")
        for side in (width, height):
            if not (side.isascii() and side.isdecimal() and len(side) < 6):
                raise self._refuse(name, value, allowed)
            if not SMALLEST <= int(side) <= LARGEST:
                raise self._refuse(name, value, allowed)
        return int(width), int(height)

    def done(self) -> None:
        """Refuse what is left, naming what there is."""
        if self._given:
            unknown = ", ".join(f"'{name}'" for name in sorted(self._given))
            raise SourceNotFoundError(f"{self._source} has no option {unknown}; it has {', '.join(self._known)}")
