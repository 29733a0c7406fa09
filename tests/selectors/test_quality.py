"""The error of a model, and the even sampling that it is held against."""

from __future__ import annotations

import numpy as np
import pytest

from selective_depth.selectors.even import EvenSelector, even_lattice, even_rank, spread
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.seeds import SeedGrid


def test_errors_are_those_of_the_pixels_with_depth() -> None:
    truth = np.array([[1000, 3000, 0, 1000]], np.uint16)
    model = np.array([[1019.0, 3061.0, 5.0, 1021.0]], np.float32)
    rmse_mm, mae_mm, wrong = errors_of(model, truth)
    assert rmse_mm == pytest.approx(np.sqrt((19**2 + 61**2 + 21**2) / 3))
    assert mae_mm == pytest.approx((19 + 61 + 21) / 3)
    assert wrong == pytest.approx(2 / 3)  # 19 mm is right; 61 mm > 2 %; 21 mm > 20 mm


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the model has shape \(3, 4\), the frame \(4, 3\)"):
        errors_of(np.ones((3, 4)), np.ones((4, 3)))
    with pytest.raises(ValueError, match="no pixel of the frame has a depth"):
        errors_of(np.ones((3, 4)), np.zeros((3, 4)))


@pytest.mark.parametrize("pixels", [50, 768, 5000, 96 * 128])
def test_an_even_lattice_has_about_so_many_pixels_of_square_pitch(pixels: int) -> None:
    uv = even_lattice((96, 128), pixels)
    assert len(np.unique(uv, axis=0)) == len(uv) == pytest.approx(pixels, rel=0.05)
    assert uv.min() >= 0 and (uv < (128, 96)).all()
    pitch_u, pitch_v = 128 / len(np.unique(uv[:, 0])), 96 / len(np.unique(uv[:, 1]))
    assert pitch_u == pytest.approx(pitch_v, rel=0.2)


def test_a_mask_is_filled_evenly_and_before_all_else() -> None:
    mask = np.zeros((64, 64), np.bool_)
    mask[:32] = True
    worth = spread(mask)
    assert worth[mask].min() > worth[~mask].max() > worth.min() > 0
    best = np.argsort(-worth, axis=None)[:128]
    tiles = np.unique(np.stack((best // 64 // 8, best % 64 // 8)), axis=1, return_counts=True)[1]
    assert len(tiles) == 32 and (tiles == 4).all(), "every 8x8 pixels get their share"
    assert not even_rank((64, 64)).flags.writeable


def test_the_even_selector_heeds_no_depth() -> None:
    one, other = (SeedGrid.from_array(np.full((64, 64), d), (16, 16)) for d in (900, 4000))
    np.testing.assert_array_equal(EvenSelector().select(one).score, EvenSelector().select(other).score)
