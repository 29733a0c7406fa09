"""The layout that lets a top-level folder `selectors/` live beside the standard library's."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_selectors_has_no_init_file() -> None:
    assert not (ROOT / "selectors" / "__init__.py").exists()


def test_standard_library_module_wins_at_the_root() -> None:
    code = "import selectors, asyncio; print(selectors.DefaultSelector.__name__)"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert out.stdout.strip().endswith("Selector")


def test_every_room_is_packaged() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    rooms = {
        "selective_depth." + ".".join(folder.relative_to(ROOT).parts)
        for house in ("app", "drivers", "selectors")
        for folder in [ROOT / house, *(ROOT / house).rglob("*")]
        if folder.is_dir() and any(folder.glob("*.py"))
    }
    assert set(settings["packages"]) == rooms | {"selective_depth.recordings"}


def test_texts_that_a_room_reads_are_packaged() -> None:
    packaged = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    texts = [path for path in (ROOT / "app").rglob("*.md") if any(path.parent.glob("*.py"))]
    assert texts
    for path in texts:
        room = "selective_depth." + ".".join(path.parent.relative_to(ROOT).parts)
        assert path.name in packaged[room]
