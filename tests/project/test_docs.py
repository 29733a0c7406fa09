"""What the documentation shows is run: its Python as written, its commands against --help."""

from __future__ import annotations

import doctest
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

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


def helps() -> dict[str, str]:
    """Help text of every command, by name."""
    from selective_depth.app import cli  # noqa: F401  (declares the commands)
    from selective_depth.app.console.command import COMMANDS

    return {
        name: subprocess.run(
            [sys.executable, "-m", "selective_depth.app", name, "--help"], capture_output=True, text=True, check=True
        ).stdout
        for name in COMMANDS
    }


@pytest.fixture(scope="module")
def help_of() -> dict[str, str]:
    return helps()


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


def test_commands_and_options_exist(help_of: dict[str, str]) -> None:
    everywhere = {"--help", "--version", "--completion", "--preset", "--settings", "--debug", "--verbose"}
    seen = 0
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for line in re.findall(r"^(?:\$ )?selective-depth .*$", text, re.MULTILINE):
            words = shlex.split(line.removeprefix("$ "), comments=True)[1:]
            if words[0].startswith("-"):
                assert words[0] in everywhere, f"{page.name}: {line}"
                continue
            assert words[0] in help_of, f"{page.name}: no command '{words[0]}' in: {line}"
            for word in words:
                option = word.partition("=")[0]
                if option.startswith("--") and option not in everywhere:
                    assert option in help_of[words[0]], f"{page.name}: no {option} in: {line}"
            seen += 1
    assert seen > 10, "the documentation shows no commands: is this test looking at it?"


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
