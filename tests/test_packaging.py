"""The layout that lets a top-level folder `selectors/` live beside the standard library's."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_selectors_has_no_init_file() -> None:
    assert not (ROOT / "selectors" / "__init__.py").exists()


def test_standard_library_module_wins_at_the_root() -> None:
    code = "import selectors, asyncio; print(selectors.DefaultSelector.__name__)"
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert out.stdout.strip().endswith("Selector")


def test_every_room_is_packaged() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert set(settings["package-dir"]) == set(settings["packages"])
    for folder in settings["package-dir"].values():
        nested = [path for path in (ROOT / folder).iterdir() if (path / "__init__.py").exists()]
        assert not nested, f"{nested} would be missing from the wheel: keep the rooms flat"
