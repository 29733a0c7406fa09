"""The house stays small: limits on files, folders and functions that hold for all later work."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from code_size import code_lines

ROOT = Path(__file__).parents[2]
HOUSES = ("app", "drivers", "selectors")
FILES = sorted(path for house in HOUSES for path in (ROOT / house).rglob("*.py"))
MOST_CODE = 16_350
MOST_LINES = 450
MOST_FILES = 14
# Lines and parameters of a function; of a compiled one, whose helpers cost inlining.
MOST_PLAIN = (80, 10)
MOST_KERNEL = (150, 12)


def functions(path: Path) -> Iterator[tuple[ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            compiled = any("njit" in ast.unparse(each) for each in node.decorator_list)
            yield node, compiled


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    every = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    return len([each for each in every if each.arg not in ("self", "cls")])


def test_the_whole_is_small() -> None:
    assert sum(code_lines(path) for path in FILES) <= MOST_CODE


def test_code_is_counted_without_blanks_comments_and_docstrings(tmp_path: Path) -> None:
    file = tmp_path / "some.py"
    file.write_text(
        '"""Doc\n\nstring."""\n\n# comment\nx = (  # one\n    1,\n)\n\n'
        'def f():\n    """Doc."""\n    return """a\nb"""\nlimit = 3\n"""What it is."""\n'
    )
    assert code_lines(file) == 3 + 1 + 2 + 1


@pytest.mark.parametrize("house", HOUSES)
def test_few_files_lie_directly_in_a_house(house: str) -> None:
    direct = list((ROOT / house).glob("*.py"))
    assert len(direct) <= MOST_FILES, [path.name for path in direct]


def test_no_file_is_long() -> None:
    long = {
        str(path.relative_to(ROOT)): count
        for path in FILES
        if (count := len(path.read_text().splitlines())) > MOST_LINES
    }
    assert not long


def test_no_function_is_long_or_takes_many_parameters() -> None:
    beyond = []
    for path in FILES:
        for node, compiled in functions(path):
            most_lines, most_parameters = MOST_KERNEL if compiled else MOST_PLAIN
            lines = (node.end_lineno or 0) - node.lineno + 1
            if lines > most_lines or parameters(node) > most_parameters:
                place = f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
                beyond.append(f"{place}: {lines} lines, {parameters(node)} parameters")
    assert not beyond, "\n".join(beyond)


def test_no_circle_of_imports() -> None:
    """Imports inside functions count."""
    found = subprocess.run(
        [sys.executable, ROOT / "tests" / "project" / "import_graph.py", "--circles"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr
