"""The import graph: `python tests/project/import_graph.py [--circles | --rooms]`.

Read from the source, so that imports inside functions and under TYPE_CHECKING count. `--rooms`
draws the arrows between rooms, `--circles` names circles of modules or of
rooms and fails if there are any.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
HOUSES = ("app", "drivers", "selectors")
PACKAGE = "selective_depth."


def graph() -> dict[str, set[str]]:
    """Modules that each module imports; a package's name stands for its `__init__`."""
    files = {_name(path): path for house in HOUSES for path in (ROOT / house).rglob("*.py")}
    return {name: _imported(path, files) - {name} for name, path in sorted(files.items())}


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, by whatever way round (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(edges[module]):
            if other not in index:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == index[module]:
            at = stack.index(module)
            group = stack[at:]
            del stack[at:]
            if len(group) > 1:
                found.append(sorted(group))

    for module in edges:
        if module not in index:
            visit(module)
    return found


def room(module: str) -> str:
    """The room of a module: a sub-package, or the file itself where it lies in none."""
    return ".".join(module.split(".")[:2])


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: Path, files: dict[str, Path]) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # A name taken from a package may be a module of it; if not, it is the package's face.
            names = [
                f"{node.module}.{alias.name}"
                if f"{node.module}.{alias.name}".removeprefix(PACKAGE) in files
                else node.module
                for alias in node.names
            ]
        else:
            continue
        found |= {name.removeprefix(PACKAGE) for name in names if name.startswith(PACKAGE)}
    return found & set(files)


def main() -> int:
    """Print what is asked for."""
    edges, between = graph(), defaultdict[str, set[str]](set)
    for module, others in edges.items():
        between[room(module)] |= {room(other) for other in others} - {room(module)}
    if "--circles" in sys.argv:
        found = circles(edges) + circles(between)
        for group in found:
            print("circle:", ", ".join(group))
        return int(bool(found))
    if "--rooms" in sys.argv:
        edges = between
    for module, others in sorted(edges.items()):
        print(f"{module} -> {', '.join(sorted(others)) or '-'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
