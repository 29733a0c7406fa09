"""A room is entered by its face: what others may use stands in its `__init__.py`."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
HOUSES = ("app", "drivers", "selectors")
SHELVES = {"app.console", "app.commands"}
"""Without one face: small modules for everybody, and commands, each imported when it is asked for."""
DOORS = {"app.benchmark.report", "app.evaluation.report"}
"""Of a command alone. Workers, which import the rooms, draw nothing and need not wait for what does."""


def test_what_lies_in_a_room_is_imported_by_its_face() -> None:
    """Imports inside functions count."""
    beyond = []
    for path in sorted(path for house in HOUSES for path in (ROOT / house).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            house, _, inside = module.removeprefix("selective_depth.").partition(".")
            room, _, hidden = inside.partition(".")
            folder = ROOT / house / room
            if f"{house}.{inside}" in DOORS:
                continue
            if hidden and folder.is_dir() and not path.is_relative_to(folder) and f"{house}.{room}" not in SHELVES:
                beyond.append(f"{path.relative_to(ROOT)}:{node.lineno} {module}")
    assert not beyond, "\n".join(beyond)
