"""What was observed at every pixel, over time, and what it comes to.

A depth sensor at a discontinuity flickers between two surfaces, so the observations of a pixel are no
Gaussian: they are fused as the mean of those that agree with their median, and those that do not
are counted, with their distance. A pixel's last `KEPT` observations are kept; medians of nine are
not enough for its edges (RMSE 37 mm where 31 of them give 33, still camera, workstation).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Bytes, Floats, Ints

KEPT = 31
"""Observations kept of a pixel."""

AGREE_MM, AGREE_SHARE = 30.0, 0.03
"""Depths agree within so many millimetres, or that share of the depth, whichever is more: three
to five times the noise of a Kinect."""

NEVER = -(1 << 30)


class Memory(NamedTuple):
    """Everything known of every pixel; arrays of shape (height, width), `ring_mm` with one more.

    Attributes
    ----------
    ring_mm : float32 array of shape (height, width, KEPT)
        Observations that returned depth, the newest over the oldest.
    place : uint8 array
        Where in the ring the next one goes.
    held : uint8 array
        How many the ring holds; 0 = not known.
    missed : uint8 array
        Shots since the last return that returned nothing.
    fused_mm : float32 array
        What the observations come to; 0 where not known.
    dissent : uint8 array
        How many of them do not agree with it.
    apart_mm2 : float32 array
        Mean squared distance of those from it.
    asked : int32 array
        Number of the frame in which the pixel was measured last, whether it returned or not.
    """

    ring_mm: Floats
    place: Bytes
    held: Bytes
    missed: Bytes
    fused_mm: Floats
    dissent: Bytes
    apart_mm2: Floats
    asked: Ints

    @classmethod
    def of(cls, shape: tuple[int, int]) -> Memory:
        """A memory of nothing."""
        small = np.zeros((4, *shape), np.uint8)
        return cls(
            ring_mm=np.zeros((*shape, KEPT), np.float32),
            place=small[0],
            held=small[1],
            missed=small[2],
            fused_mm=np.zeros(shape, np.float32),
            dissent=small[3],
            apart_mm2=np.zeros(shape, np.float32),
            asked=np.full(shape, NEVER, np.int32),
        )


@njit(cache=True, nogil=True)
def _fuse(values: Floats, before_mm: float) -> tuple[float, int, float]:
    """Mean of what agrees with the median, how many do not, and their mean squared distance.

    Of two middle values the one nearer to what was fused before is taken: their mean may lie
    between two surfaces, where nothing is. `values` is sorted on the way.
    """
    n = len(values)
    for i in range(1, n):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    lower, upper = np.float64(values[(n - 1) // 2]), np.float64(values[n // 2])
    middle = lower if abs(lower - before_mm) <= abs(upper - before_mm) else upper
    tolerance = max(AGREE_MM, AGREE_SHARE * middle)
    total = apart = 0.0
    agreeing = 0
    for value in values:
        off = np.float64(value) - middle
        if abs(off) <= tolerance:
            total += value
            agreeing += 1
        else:
            apart += off * off
    dissent = n - agreeing
    return total / agreeing, dissent, apart / max(dissent, 1)


@njit(cache=True, nogil=True)
def book(memory: Memory, uv: Ints, depth_mm: Floats, now: int) -> None:
    """Take in measurements of frame `now`: pixels (n, 2), column first, and depth, 0 = no return.

    A pixel that has missed three times, and more often than it had returned, is known no more.
    """
    values = np.empty(KEPT, np.float32)
    for i in range(len(uv)):
        u, v, z = uv[i, 0], uv[i, 1], depth_mm[i]
        memory.asked[v, u] = now
        if z <= 0:
            missed = min(memory.missed[v, u] + 1, 255)
            memory.missed[v, u] = missed
            if missed >= 3 and missed > memory.held[v, u] > 0:
                memory.held[v, u] = memory.place[v, u] = memory.dissent[v, u] = 0
                memory.fused_mm[v, u] = 0
            continue
        memory.missed[v, u] = 0
        place = memory.place[v, u]
        memory.ring_mm[v, u, place] = z
        memory.place[v, u] = (place + 1) % KEPT
        count = min(memory.held[v, u] + 1, KEPT)
        memory.held[v, u] = count
        values[:count] = memory.ring_mm[v, u, :count]
        fused, dissent, apart = _fuse(values[:count], memory.fused_mm[v, u])
        memory.fused_mm[v, u] = fused
        memory.dissent[v, u] = dissent
        memory.apart_mm2[v, u] = apart


def forget(memory: Memory, where: Bools | slice) -> None:
    """Know nothing of some pixels any more."""
    for layer in (memory.place, memory.held, memory.missed, memory.fused_mm, memory.dissent):
        layer[where] = 0


def forget_all(memory: Memory) -> None:
    """Know nothing any more; a new memory's pages would have to be got, one by one."""
    forget(memory, slice(None))
    memory.asked.fill(NEVER)
