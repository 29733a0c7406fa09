"""A disk that fills at any byte: what was there stays whole, nothing half stands under a final name."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SCENE = "virtual:ball?size=64x48&frames=2"
LARGER = "virtual:ball?size=192x144&frames=1"
SEEDS = ("--seeds.rows", "12", "--seeds.columns", "16")
SELECTORS = (*SEEDS, "--gas.nodes", "60")
COMPARED = ("--budget", "0.05", "--strategies", "uniform", "--every", "1", "--jobs", "1")
COMMANDS = {
    "export folder": ("export", SCENE, "{out}/frames"),
    "export oni": ("export", SCENE, "{out}/x.oni"),
    "export mcap": ("export", SCENE, "{out}/x.mcap"),
    "repair": ("check", "{source}", "--repair", "{out}/mended.oni"),
    "snapshot": ("snapshot", SCENE, "--out", "{out}/stills", "--budget", "0.05", *SELECTORS),
    "sheet": ("snapshot", SCENE, "--out", "{out}/sheet.png", *SELECTORS),
    "model": ("model", SCENE, "{out}/model", *SELECTORS),
    "figure": ("figure", "4", SCENE, "--out", "{out}/figure.pdf", *SELECTORS),
    "evaluate json": ("evaluate", LARGER, *COMPARED, "--json", "{out}/e.json"),
    "evaluate table": ("evaluate", LARGER, *COMPARED, "--table", "{out}/e.parquet"),
    "evaluate page": ("evaluate", LARGER, *COMPARED, "--page", "{out}/e.md"),
}
NEW_ONLY = ("export", "repair")
"""What refuses to replace anything: there the next attempt must find its way free."""


class Machine:
    """A disk whose size is told for each command."""

    def __init__(self) -> None:
        script = Path(__file__).parents[1] / "filling.py"
        self._process = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, words: list[str], limit: int | None = None) -> tuple[int, str]:
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps([limit, words]), file=self._process.stdin, flush=True)
        code, printed = json.loads(self._process.stdout.readline())
        return code, printed

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    made = Machine()
    yield made
    made.close()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def fill(machine: Machine, name: str, folder: Path, times: int) -> None:
    out, source = folder / "out", folder / "source.oni"
    out.mkdir()
    if name == "repair":
        assert machine.run(["export", SCENE, str(source)])[0] == 0
        source.write_bytes(source.read_bytes()[:-200])
    words = [word.format(out=out, source=source) for word in COMMANDS[name]]
    code, printed = machine.run(words)
    assert code == 0, printed
    before = contents(out)
    largest = max(map(len, before.values()))
    draw = random.Random(name)
    for limit in sorted(draw.randrange(largest) for _ in range(times)):
        if name.startswith(NEW_ONLY):
            shutil.rmtree(out)
            out.mkdir()
        code, printed = machine.run(words, limit)
        sentences = [line for line in printed.splitlines() if line.startswith("selective-depth: ")]
        assert code == 1 and len(sentences) == 1 and "cannot be written" in sentences[0], (limit, code, printed)
        assert "Traceback" not in printed and "unexpected" not in printed
        left = contents(out)
        if name.startswith(NEW_ONLY):
            assert left == {}, limit
            code, printed = machine.run(words)
            assert code == 0, printed
        elif name not in ("snapshot", "model"):
            assert left == before, limit
        else:  # several files, each of them whole
            assert set(left) == set(before), limit


@pytest.mark.parametrize("name", ["export folder", "export oni", "repair", "model", "evaluate json"])
def test_a_command_that_writes_leaves_all_or_nothing(name: str, machine: Machine, tmp_path: Path) -> None:
    fill(machine, name, tmp_path, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_at_twenty_bytes(name: str, machine: Machine, tmp_path: Path) -> None:
    fill(machine, name, tmp_path, 20)
