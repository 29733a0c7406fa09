"""Refinement by a quad-tree: cells where the surface between the measured corners was most in error are split.

In the manner of Shih et al. 2008 (reference 8 of the paper): what is measured is compared with what
the corners of its cell predicted, and the cells that were predicted worst are refined first.
"""

from __future__ import annotations

import heapq
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.seeds import Measure, SeedGrid

_Cell = tuple[int, int, int, int]


def quadtree(measure: Measure, seeds: SeedGrid, shots: int) -> npt.NDArray[np.int32]:
    """Spend a budget by splitting cells, the one with the largest error first.

    A cell between four seeds begins with the range of their depths; a quarter of a cell with the
    largest difference between what was measured on its rim and the mean or bilinear middle of the
    corners before. A split measures the middle and those middles of the sides that are new. Where
    no corner returned depth nothing is split.

    Parameters
    ----------
    measure : callable
        The sensor: pixels (n, 2), column first, to depth (n,) in millimetres, 0 = no return.
    seeds : SeedGrid
        The corners of the first cells.
    shots : int
        Measurements at most.

    Returns
    -------
    int32 array of shape (n, 2)
        Pixels measured, column first, the seeds first.
    """
    rows, columns = seeds.rows.tolist(), seeds.columns.tolist()
    order = [(u, v) for v in rows for u in columns]
    known = dict(zip(order, seeds.depth_mm.ravel().tolist(), strict=True))
    heap: list[tuple[float, _Cell]] = []

    def corners(cell: _Cell) -> list[float]:
        u0, v0, u1, v1 = cell
        found = [known[u, v] for u, v in ((u0, v0), (u1, v0), (u0, v1), (u1, v1))]
        return [z for z in found if z > 0]

    def offer(cell: _Cell, error: float) -> None:
        if (cell[2] - cell[0] > 1 or cell[3] - cell[1] > 1) and corners(cell):
            heapq.heappush(heap, (-error, cell))

    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            cell = left, top, right, bottom
            depths = corners(cell) or [0.0]
            offer(cell, max(depths) - min(depths))
    left_over = shots
    while heap and left_over > 0:
        _, (u0, v0, u1, v1) = heapq.heappop(heap)
        middle_u, middle_v = (u0 + u1) // 2, (v0 + v1) // 2
        expected = {
            pixel: float(np.mean(corners(rim) or [0.0]))
            for pixel, rim in {
                (middle_u, middle_v): (u0, v0, u1, v1),
                (middle_u, v0): (u0, v0, u1, v0),
                (middle_u, v1): (u0, v1, u1, v1),
                (u0, middle_v): (u0, v0, u0, v1),
                (u1, middle_v): (u1, v0, u1, v1),
            }.items()
        }
        new = [pixel for pixel in expected if pixel not in known][:left_over]
        if new:
            answers = np.asarray(measure(np.array(new, np.int32)), np.float64)
            known |= dict(zip(new, answers.tolist(), strict=True))
            order += new
            left_over -= len(new)
        error = {pixel: abs(known[pixel] - expected[pixel]) if known.get(pixel, 0) > 0 else 0.0 for pixel in expected}
        if left_over > 0:
            for (a, b), (c, d) in product(pairwise((u0, middle_u, u1)), pairwise((v0, middle_v, v1))):
                if a < b and c < d:
                    offer((a, c, b, d), max(error.get(pixel, 0.0) for pixel in product((a, b), (c, d))))
    return np.array(order, np.int32)
