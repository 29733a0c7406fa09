"""Which selector drives the shots, from its name to the report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from selective_depth.app.cli import run
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline.pipeline import Pipeline
from selective_depth.app.pipeline.selecting import SELECTOR_NAMES, selector_of
from selective_depth.app.settings import AcquireOptions, GasOptions, SeedOptions, Settings
from selective_depth.drivers.frame import Camera, DepthFrame

SMALL = Settings(seeds=SeedOptions(24, 32), gas=GasOptions(nodes=60))
OWN = """
import numpy as np

def leftmost(samples):
    rows, columns = np.indices(samples.frame_shape)
    return samples.frame_shape[1] - columns

class Rightmost:
    name = "the right side"
    def select(self, samples):
        from selective_depth.selectors.samples import Samples
        from selective_depth.selectors.selection import Selection
        shape = Samples.of(samples).frame_shape
        return Selection.of_score(np.indices(shape, np.float32)[1] + 1, self.name)

nothing = 7
"""


def with_by(by: str, rounds: int = 2) -> Settings:
    return dataclasses.replace(SMALL, acquire=AcquireOptions(budget=0.02, rounds=rounds, by=by))


def shots(by: str, rounds: int = 2) -> tuple[str, np.ndarray]:
    depth_mm = np.full((96, 128), 2000, np.uint16)
    depth_mm[30:60, 40:90] = 1200
    depth_mm[:10, :10] = 0
    frame = DepthFrame(depth_mm, 0, 0, Camera.kinect(128, 96))
    with Pipeline(with_by(by, rounds)) as pipeline:
        acquisition = pipeline.make(frame).acquisition
    assert acquisition is not None
    return acquisition.by, acquisition.uv[acquisition.round > 0]


def test_every_name_drives_the_shots_its_own_way() -> None:
    chosen = {name: shots(name) for name in SELECTOR_NAMES}
    names = [by for by, _ in chosen.values()]
    assert all(names)
    assert chosen["auto"][0] == chosen["surface"][0] == "surface score"
    assert shots("auto", rounds=1)[0] == "step score"
    sets = {name: {tuple(p) for p in uv.tolist()} for name, (_, uv) in chosen.items()}
    assert sets.pop("auto") == sets["surface"]
    assert len({frozenset(each) for each in sets.values()}) == len(sets)


@pytest.mark.parametrize(("name", "by"), [("leftmost", "leftmost"), ("Rightmost", "the right side")])
def test_a_selector_of_one_s_own_comes_from_a_file(tmp_path: Path, name: str, by: str) -> None:
    file = tmp_path / "own.py"
    file.write_text(OWN)
    named, uv = shots(f"{file}:{name}")
    assert named == by
    middle = uv[:, 0].mean()
    assert middle < 32 if name == "leftmost" else middle > 96


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ("nope", "must be one of auto, surface"),
        ("missing.py:f", "there is no file 'missing.py'"),
        ("own.py:absent", "has no function or selector 'absent'"),
        ("own.py:nothing", "has no function or selector 'nothing'"),
        ("broken.py:f", "fails: ZeroDivisionError"),
    ],
)
def test_what_is_no_selector_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    Path("broken.py").write_text("1 / 0")
    with pytest.raises(UsageError, match=words):
        selector_of(with_by(by), None)


def test_the_report_and_the_settings_name_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = tmp_path / "run.rrd"
    words = ["replay", "virtual:ball?size=128x96&frames=2", "--seeds.rows", "24", "--seeds.columns"]
    words += ["32", "--gas.nodes", "60", "--budget", "0.02", "--by", "even", "--headless", "--save"]
    assert run([*words, str(saved)]) == 0
    assert "even" in capsys.readouterr().out.split("shots chosen by")[1].split("\n")[0]
    assert 'by = "even"' in saved.with_suffix(".toml").read_text()
