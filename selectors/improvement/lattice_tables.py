"""Tables that make kriging on a lattice cheap: one eigendecomposition per window geometry.

The nine seeds of a window without holes stand in one of a few geometries. For each, ordinary
kriging is solved once, for every semivariogram: with H the distances^w between the seeds and V
an orthonormal basis of the contrasts (vectors that sum to zero) that diagonalises ``-V'HV =
diag(mu)``, mu > 0 for 0 < w < 2. The nugget b only adds b to each of a mu. With h(s) the
distances^w from the seeds to a pixel s, ``mean`` the mean over the seeds and

    g(s) = V'(h(s) - mean of H's rows),      f(s) = mean h(s) - mean H / 2,

the system of eq. (5)-(10) and the covariances of eq. (21) are

    z(s)     = mean Z - sum_i y_i a / (a mu_i + b) g_i(s),            y = V'Z
    cov(s,j) = a (f(s) + f(j) - h(s,j)) + b / 9 (+ b if s = j)
               - sum_i a^2 / (a mu_i + b) g_i(s) g_i(j),

`var(s) = cov(s, s)`. Products ``g_i(s) g_i(j)`` are tabulated for the pairs that the map needs:
a pixel with itself, with the one to its right and with the one below. The moments of the local
semivariogram come out of y as well: with x = Z - mean Z,

    sum over pairs of (z_p - z_q)^2           = 9 sum_i y_i^2
    sum over pairs of (z_p - z_q)^2 h_pq^w    = sum_k x_k^2 sum_q h_kq^w + sum_i mu_i y_i^2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import Bools, Doubles, Floats, Longs
from selective_depth.selectors.improvement.systems import aligned_empty, padded_pixels

SEEDS = 9
"""Seeds in a window without holes."""
CONTRASTS = SEEDS - 1
"""Dimensions of a window's system once the mean is taken out."""


class LatticeTables(NamedTuple):
    """Tables of all window geometries, one after the other.

    Pixels of a window are numbered row by row with a rim of one pixel on every side; pairs are
    numbered: first every pixel inside the rim with itself, then each row's horizontal pairs
    from the rim on the left to the rim on the right, then the vertical pairs likewise.

    Parameters
    ----------
    first_pixel, first_pair : int64 array of shape (geometries,)
        Where a geometry's pixels and pairs begin.
    distances : float32 array of shape (9, pixels)
        Distance^w from each seed of the window to each pixel.
    between : float64 array of shape (geometries, 9, 9)
        Distance^w between the seeds.
    vectors : float32 array of shape (pixels, 8)
        g of each pixel.
    is_seed : bool array of shape (pixels,)
        Whether a seed stands there.
    products : float32 array of shape (pairs, 8)
        g_i(s) g_i(j) of each pair.
    bases : float32 array of shape (pairs,)
        f(s) + f(j) - h(s, j) of each pair.
    basis : float32 array of shape (geometries, 8, 9)
        V, transposed.
    eigenvalues : float32 array of shape (geometries, 8)
        mu.
    distance_sums : float32 array of shape (geometries, 9)
        Sum of the distances^w from each seed to the others.
    moments : float32 array of shape (geometries, 2)
        Sums over the pairs of seeds of h^w and h^2w.
    """

    first_pixel: Longs
    first_pair: Longs
    distances: Floats
    between: Doubles
    vectors: Floats
    is_seed: Bools
    products: Floats
    bases: Floats
    basis: Floats
    eigenvalues: Floats
    distance_sums: Floats
    moments: Floats


def build_tables(geometries: list[tuple[int, int, int, int]], exponent: float) -> LatticeTables:
    """Tabulate window geometries.

    Parameters
    ----------
    geometries : list of (up, down, left, right)
        Distances in pixels from a window's centre to the seeds around it.
    exponent : float
        The w of eq. (24), in (0, 2).
    """
    parts = [_tabulate(*geometry, exponent) for geometry in geometries]
    tables: dict[str, npt.NDArray[Any]] = {}
    for name in parts[0]:
        whole = np.concatenate([part[name] for part in parts], axis=1 if name == "distances" else 0)
        tables[name] = whole if name in ("between", "is_seed") else aligned_empty(*whole.shape)
        tables[name][...] = whole
    for name, table in (("first_pixel", "is_seed"), ("first_pair", "bases")):
        tables[name] = np.cumsum([0, *(len(part[table]) for part in parts[:-1])])
    return LatticeTables(**tables)


def _tabulate(up: int, down: int, left: int, right: int, exponent: float) -> dict[str, npt.NDArray[np.generic]]:
    half = exponent / 2
    v, u = (axis.ravel() for axis in np.meshgrid((-up, 0, down), (-left, 0, right), indexing="ij"))
    H = ((u[:, None] - u) ** 2.0 + (v[:, None] - v) ** 2.0) ** half
    # An orthonormal basis of the contrasts: the rest of a QR whose first column is constant.
    start = np.eye(SEEDS)
    start[:, 0] = 1
    contrasts = np.linalg.qr(start)[0][:, 1:]
    eigenvalues, turn = np.linalg.eigh(-contrasts.T @ H @ contrasts)
    V = contrasts @ turn

    height, width = up + down + 1, left + right + 1
    y, x = np.mgrid[-up : down + 1, -left : right + 1]
    h = ((x.ravel() - u[:, None]) ** 2.0 + (y.ravel() - v[:, None]) ** 2.0) ** half
    g = V.T @ (h - H.mean(axis=1, keepdims=True))
    f = h.mean(axis=0) - H.mean() / 2

    # Loops over pixels run on behind the last.
    rest = padded_pixels(width - 2, height - 2) - height * width
    number = np.arange(height * width).reshape(height, width)
    itself = number[1:-1, 1:-1].ravel()
    across, down_from = number[1:-1, :-1].ravel(), number[:-1, 1:-1].ravel()
    one = np.concatenate((itself, across, down_from))
    other = np.concatenate((itself, across + 1, down_from + width))
    return {
        "distances": np.pad(h, ((0, 0), (0, rest))),
        "between": H[None],
        "vectors": np.pad(g.T, ((0, rest), (0, 0))),
        "is_seed": np.pad((h == 0).any(axis=0), (0, rest)),
        "products": (g[:, one] * g[:, other]).T,
        # Neighbouring pixels are 1 apart, and 1^w = 1.
        "bases": f[one] + f[other] - (one != other),
        "basis": V.T[None],
        "eigenvalues": eigenvalues[None],
        "distance_sums": H.sum(axis=1)[None],
        "moments": np.array([(H.sum() / 2, (H**2).sum() / 2)]),
    }
