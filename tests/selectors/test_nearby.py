"""The nearest points, against all distances."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from selective_depth.selectors.nearby import nearest_points


@pytest.mark.parametrize(("points", "count"), [(50, 4), (50, 1), (3, 4), (1, 1)])
def test_they_are_those_of_all_distances(points: int, count: int) -> None:
    draw = np.random.default_rng(points + count)
    there, places = draw.normal(size=(points, 3)), draw.normal(size=(20, 3))
    distance, index = nearest_points(there, places, count)
    every = np.linalg.norm(places[:, None] - there, axis=2)
    assert index.shape == (20, min(count, points))
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, :count])
    np.testing.assert_allclose(np.take_along_axis(every, index, axis=1), distance)


def test_a_run_begins_without_what_takes_long_to_import() -> None:
    code = "import selective_depth.app.commands.run, sys; print([m for m in sys.modules if m.startswith('scipy.')])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "spatial" not in run.stdout and "special" not in run.stdout and "ndimage" not in run.stdout
