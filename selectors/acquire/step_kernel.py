"""The step score's kernel: the nearest samples of a pixel, found by the bits of its rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats

# Position of the lowest set bit of a word: multiplied by a de Bruijn sequence, each single bit
# leaves another number in the top six bits.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_OF = np.zeros(64, np.int64)
for _bit in range(64):
    _BIT_OF[((1 << _bit) * int(_DE_BRUIJN) & (2**64 - 1)) >> 58] = _bit


class StepRule(NamedTuple):
    """The score's parameters.

    Parameters
    ----------
    weight_of : float32 array of shape (distances,)
        A vote's weight by squared distance, pixels.
    vote_px : int
        How far a sample has a say, pixels.
    reach_px : float
        How far from a return a pixel may be shot, pixels.
    voters : int
        How many samples vote.
    gap_px, noise_mm2 : float
        Greatest gap that counts, pixels; variance where all agree, mm^2.
    """

    weight_of: Floats
    vote_px: int
    reach_px: float
    voters: int
    gap_px: float
    noise_mm2: float


@njit(cache=True, nogil=True)
def score_rows(
    first: int, end: int, image_mm: Floats, bits: npt.NDArray[np.uint64], rule: StepRule,
    score: Floats,
) -> None:  # fmt: skip
    """Score some rows of pixels, mm^2 times pixels; 0 where no shot is to be made.

    Parameters
    ----------
    first, end : int
        The rows.
    image_mm : float32 array of shape (H, W)
        Depth, `MISSED`, or 0 where nothing was measured.
    bits : uint64 array of shape (H, words)
        One bit per measured pixel, behind one word of zeros.
    rule : StepRule
        The score.
    score : float32 array of shape (H, W)
        Filled in.
    """
    height, width = image_mm.shape
    vote_px, voters = rule.vote_px, rule.voters
    one, whole = np.uint64(1), (np.uint64(1) << np.uint64(2 * vote_px + 1)) - np.uint64(1)
    near_sq, near_mm = np.empty(voters, np.int64), np.empty(voters, np.float32)
    missed_sq = np.empty((2 * vote_px + 1) ** 2, np.int64)
    for v in range(first, end):
        for u in range(width):
            score[v, u] = 0
            if image_mm[v, u] != 0:
                continue
            farthest = vote_px * vote_px
            found = misses = 0
            start = u - vote_px + 64  # the padding's width in bits
            word, shift = start >> 6, np.uint64(start & 63)
            for step in range(2 * vote_px + 1):  # rows, the nearest first
                dv = (step + 1) // 2 if step & 1 else -(step // 2)
                if dv * dv > farthest:
                    break
                y = v + dv
                if not 0 <= y < height:
                    continue
                window = bits[y, word] >> shift
                if shift > 0:
                    window |= bits[y, word + 1] << (np.uint64(64) - shift)
                window &= whole
                while window:
                    lowest = window & (~window + one)
                    window ^= lowest
                    du = _BIT_OF[(lowest * _DE_BRUIJN) >> np.uint64(58)] - vote_px
                    d = du * du + dv * dv
                    if d > farthest:
                        continue
                    z = image_mm[y, u + du]
                    if z < 0:
                        missed_sq[misses] = d
                        misses += 1
                    elif found < voters or d < near_sq[voters - 1]:
                        at = min(found, voters - 1)
                        while at > 0 and near_sq[at - 1] > d:
                            near_sq[at], near_mm[at] = near_sq[at - 1], near_mm[at - 1]
                            at -= 1
                        near_sq[at], near_mm[at] = d, z
                        found = min(found + 1, voters)
                        if found == voters:
                            farthest = near_sq[voters - 1]
            if found == 0 or near_sq[0] > rule.reach_px * rule.reach_px:
                continue
            returned = total = spread = np.float32(0)
            for k in range(found):
                returned += rule.weight_of[near_sq[k]]
                total += rule.weight_of[near_sq[k]] * near_mm[k]
            mean = total / returned
            for k in range(found):
                spread += rule.weight_of[near_sq[k]] * (near_mm[k] - mean) ** 2
            asked = returned
            for k in range(misses):
                if missed_sq[k] <= farthest:
                    asked += rule.weight_of[missed_sq[k]]
            gap_px = (np.sqrt(near_sq[0]) + np.sqrt(near_sq[min(1, found - 1)])) / 2
            expected_mm2 = spread / returned + rule.noise_mm2
            score[v, u] = expected_mm2 * min(gap_px, rule.gap_px) * np.sqrt(returned / asked)
