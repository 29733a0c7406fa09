"""Files of every version that was ever written are read; those of a later one are refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from selective_depth.app import cli
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.settings_file import SCHEMA, settings_arguments, to_toml
from selective_depth.app.settings import Settings
from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.folder.images import write_png
from selective_depth.drivers.folder.sidecar import SCHEMA as SIDECAR_SCHEMA
from selective_depth.drivers.open import open_source

_RUN = "frames = 3\nbudget = 0.05\nheadless = true\n[gas]\nnodes = 200\n"
SETTINGS = {
    0: f"# Settings of a run of selective-depth 0.1.0\n{_RUN}",
    1: f"# Settings of a run of selective-depth\nschema = 1\n{_RUN}",
}
SIDECARS = {
    0: "values_per_metre = 5000.0\nfps = 15.0\ntimestamps_us = [5]\n",
    1: "schema = 1\nvalues_per_metre = 5000.0\nfps = 15.0\ntimestamps_us = [5]\ncolour_registered = true\n",
}


@pytest.mark.parametrize("version", SETTINGS)
def test_settings_of_every_version_are_read(version: int, tmp_path: Path) -> None:
    assert max(SETTINGS) == SCHEMA
    file = tmp_path / "settings.toml"
    file.write_text(SETTINGS[version])
    seeds = ("--seeds.rows", "24", "--seeds.columns", "32")
    saved = ("--settings", str(file), "--save", str(tmp_path / "x.rrd"))
    assert cli.run(["replay", "virtual:ball?size=160x120", *seeds, *saved]) == 0
    written = (tmp_path / "x.toml").read_text()
    assert f"schema = {SCHEMA}" in written and "nodes = 200" in written and "budget = 0.05" in written


def test_what_is_written_is_of_the_present_version() -> None:
    assert f"\nschema = {SCHEMA}\n" in to_toml(Settings(), "heading")


@pytest.mark.parametrize("schema", ["2", "99999999999999999999", '"new"', "true", "1.0"])
def test_later_settings_are_refused(schema: str, tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text(f"schema = {schema}\nbudget = 0.05\n")
    with pytest.raises(UsageError, match=r"has schema .*, but this version reads up to 1; a later version wrote it"):
        settings_arguments(file, {})


@pytest.mark.parametrize("version", SIDECARS)
def test_sidecars_of_every_version_are_read(version: int, tmp_path: Path) -> None:
    assert max(SIDECARS) == SIDECAR_SCHEMA
    write_png(tmp_path / "0.png", np.full((6, 8), 10_000, np.uint16))
    (tmp_path / "frames.toml").write_text(SIDECARS[version])
    with open_source(tmp_path) as source:
        frame = source.read()
    assert (frame.depth_mm == 2000).all() and frame.timestamp_us == 5 and source.fps == 15


def test_a_later_sidecar_is_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", np.full((6, 8), 10_000, np.uint16))
    (tmp_path / "frames.toml").write_text("schema = 2\n")
    with pytest.raises(DamagedRecordingError, match=r"'schema' in .* got 2; allowed is up to 1"):
        open_source(tmp_path)
