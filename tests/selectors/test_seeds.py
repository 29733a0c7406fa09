"""The seed lattice: where it lies, and that rows stay rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.seeds import SeedGrid, cell_centres


@given(st.integers(1, 2000), st.data())
def test_seeds_are_the_centres_of_equal_cells(pixels: int, data: st.DataObject) -> None:
    cells = data.draw(st.integers(1, pixels))
    expected = [int((i + 0.5) * pixels / cells) for i in range(cells)]
    centres = cell_centres(pixels, cells)
    np.testing.assert_allclose(centres, expected, atol=1)  # floats may fall one short
    assert (np.diff(centres) > 0).all()
    assert centres[0] >= 0 and centres[-1] < pixels


def test_pattern_on_a_kinect_frame() -> None:
    assert np.diff(cell_centres(640, 128)).tolist() == [5] * 127
    assert set(np.diff(cell_centres(480, 128)).tolist()) == {3, 4}
    assert cell_centres(480, 128)[4] - cell_centres(480, 128)[0] == 15


@pytest.mark.parametrize("cells", [0, -1, 481])
def test_a_lattice_that_does_not_fit_is_refused(cells: int) -> None:
    with pytest.raises(ValueError, match="between 1 and 480"):
        cell_centres(480, cells)


def test_rows_and_columns_are_not_swapped() -> None:
    v, u = np.indices((480, 640))
    depth = (1000 + 10 * v + u % 7).astype(np.uint16)
    frame = DepthFrame(depth, 0, 0, Camera.kinect())
    seeds = SeedGrid.from_frame(frame, shape=(64, 96))
    assert seeds.shape == seeds.depth_mm.shape == (64, 96)
    u_of, v_of = seeds.lattice_uv[10, 20]
    assert seeds.depth_mm[10, 20] == depth[v_of, u_of]
    assert (u_of, v_of) == (seeds.columns[20], seeds.rows[10])


def test_missing_seeds_stay_in_the_lattice_and_out_of_the_points() -> None:
    depth = np.full((480, 640), 1500, np.uint16)
    depth[:240] = 0
    seeds = SeedGrid.from_frame(DepthFrame(depth, 0, 0, Camera.kinect()))
    assert seeds.depth_mm.shape == (128, 128)
    assert len(seeds.points_mm) == len(seeds.uv) == int(seeds.valid.sum()) == 128 * 64
    assert np.isfinite(seeds.points_mm).all()
    assert np.isnan(seeds.lattice_points_mm[0]).all()


def test_a_sensor_without_pinhole_brings_its_own_points() -> None:
    distance_mm = np.full((32, 360), 4000.0)
    distance_mm[3, 5] = np.nan
    points_mm = np.random.default_rng(0).normal(size=(32, 360, 3))
    seeds = SeedGrid.from_array(distance_mm, (32, 360), points_mm=points_mm)
    assert not seeds.valid[3, 5]
    np.testing.assert_allclose(seeds.lattice_points_mm[4, 5], points_mm[4, 5], rtol=1e-6)
    assert len(seeds.points_mm) == 32 * 360 - 1


def test_points_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(4, 6, 3\)"):
        SeedGrid.from_array(np.ones((4, 6)), (2, 3), points_mm=np.ones((6, 4, 3)))
