"""What the documentation shows is run: its Python as written, its commands by the real parser."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import inspect
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from selective_depth.app import cli  # noqa: F401  (declares the commands)
from selective_depth.app.console import dispatch
from selective_depth.app.console.command import SOURCE_OPTIONS, find, parse_with_settings

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "app" / "docs").glob("*.md")),
    *sorted((ROOT / "recordings").glob("*.md")),
]


def blocks(language: str) -> list[object]:
    pattern = re.compile(rf"^```{language}\n(.*?)^```", re.DOTALL | re.MULTILINE)
    return [
        pytest.param(found.group(1), id=f"{page.name}:{page.read_text()[: found.start()].count(chr(10)) + 1}")
        for page in PAGES
        for found in pattern.finditer(page.read_text())
    ]


@pytest.mark.parametrize("code", blocks("python"))
def test_python_runs_as_written(code: str, tmp_path: Path) -> None:
    (tmp_path / "recordings").symlink_to(ROOT / "recordings")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "module",
    [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "selectors").rglob("*.py")
        if ">>>" in path.read_text()
    ],
)
def test_docstring_examples_give_what_they_say(module: str) -> None:
    found = doctest.testmod(importlib.import_module(f"selective_depth.{module}"))
    assert found.attempted > 0
    assert found.failed == 0


def commands_of(page: Path) -> list[list[str]]:
    """Words of each command of ours in the console blocks of a page, in their order."""
    text = re.sub(r"\\\n *", "", page.read_text())
    lines = [line for block in re.findall(r"^```console\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
             for line in block.splitlines()]  # fmt: skip
    words = [shlex.split(line, comments=True) for line in lines if line.startswith("selective-depth ")]
    return [each[1 : each.index(">") if ">" in each else None] for each in words]


def files_of(words: list[str]) -> tuple[list[str], list[Path]]:
    """What a command reads and what it makes, as the real parser understands it."""
    typed = words[1:]
    taken = {name: dispatch._value(typed, f"--{name}", "a value") for name in ("settings", "preset", *SOURCE_OPTIONS)}
    call = parse_with_settings(find(words[0]), typed, None, taken["preset"])
    bound = inspect.signature(call.func).bind(*call.args, **call.keywords).arguments  # type: ignore[attr-defined]
    read: list[str] = []
    made: list[Path] = []
    for name, value in bound.items():
        if name in ("source", "sources") and value:
            read += [value] if isinstance(value, str) else value
        elif name == "paths":
            read += value[:-1]
            made.append(Path(value[-1]))
        elif name == "recording":
            read.append(str(value))
        else:
            parts = vars(value).values() if dataclasses.is_dataclass(value) else [value]
            nested = [each for part in parts if dataclasses.is_dataclass(part) for each in vars(part).values()]
            made += [each for each in (*parts, *nested) if isinstance(each, Path)]
    return read, made


@pytest.mark.parametrize("page", [pytest.param(page, id=page.name) for page in PAGES if commands_of(page)])
def test_commands_parse_and_what_they_read_is_there(page: Path) -> None:
    """Bundled, made by a command before it on the page, or said to stand for something of the reader's own."""
    paragraphs = [
        each for each in page.read_text().split("\n\n") if re.search(r"stands? for .*your own", each, re.DOTALL)
    ]
    own = {span.rstrip("/") for each in paragraphs for span in re.findall(r"`([^`]+)`", each)}
    there: set[str] = set()
    for words in commands_of(page):
        if words[0].startswith("-"):
            assert words[0] in ("--help", "--version", "--completion")
            continue
        read, made = files_of(words)
        for each in read:
            name = each.partition("?")[0].rstrip("/")
            made_up = name.startswith(("virtual:", "openni")) or name == "-"
            assert made_up or name in own | there or (ROOT / name).exists(), f"{page.name}: {' '.join(words)}"
        there |= {str(path) for path in made}


def test_the_readme_needs_nothing_of_the_readers() -> None:
    assert len(commands_of(ROOT / "README.md")) > 15
    assert "stands for" not in (ROOT / "README.md").read_text()
    assert not any("../" in word for words in commands_of(ROOT / "README.md") for word in words)


def test_commands_of_ours_stand_in_console_blocks_alone() -> None:
    for page in PAGES:
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            assert language == "console" or not re.search(r"^\$? ?selective-depth ", block, re.MULTILINE), page.name


def test_what_is_made_is_a_target_of_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        assert set(re.findall(r"^make ([a-z-]+)", page.read_text(), re.MULTILINE)) <= targets


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
