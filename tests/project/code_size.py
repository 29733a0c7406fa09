"""How much code there is: lines that are neither blank, comment nor docstring."""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from pathlib import Path

_SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(path: Path) -> int:
    """Lines of code in one file."""
    text = path.read_text()
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _SILENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            if isinstance(statement, ast.Expr) and is_text(statement.value):
                lines.difference_update(range(statement.lineno, (statement.end_lineno or 0) + 1))
    return len(lines)


def is_text(node: ast.expr) -> bool:
    """Whether an expression is a plain string: on a line of its own, a docstring."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


if __name__ == "__main__":
    total = 0
    for house in sys.argv[1:] or ("app", "drivers", "selectors"):
        files = {path: code_lines(path) for path in sorted(Path(house).rglob("*.py"))}
        for path, count in files.items():
            print(f"{count:6,} {path}")
        print(f"{sum(files.values()):6,} in {house}\n")
        total += sum(files.values())
    print(f"{total:6,} in all")
