"""The step score's kernel: blocks of 3x3 pixels, whose search for samples is one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit

Image = npt.NDArray[np.float32]
Number = float | np.float32

SLOTS = 6
"""Voters of a pixel, at most."""

_LANES = 16  # pixels of a block that are computed at once
_CORNER_PX = np.sqrt(2.0)  # from the middle of a block to its farthest pixel
_NONE = np.float32(1 << 23)  # greater than all that stand for a sample
_USED_LANES = 11  # 3x3 of the 4x4: 16 numbers are as quickly computed as 9
_0, _HALF, _1, _4096 = np.float32(0), np.float32(0.5), np.float32(1), np.float32(4096)

# Position of the lowest set bit of a word: multiplied by a de Bruijn sequence, each single bit
# leaves another number in the top six bits.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_OF = np.zeros(64, np.int64)
for _bit in range(64):
    _BIT_OF[((1 << _bit) * int(_DE_BRUIJN) & (2**64 - 1)) >> 58] = _bit


@njit(cache=True, nogil=True, inline="always")
def most_worth(low_mm: Number, high_mm: Number, gap_px: Number, noise_mm2: Number) -> float:
    """Upper bound of the score of a pixel whose voters' depths lie between two values."""
    # A variance is never more than a quarter of the squared range (Popoviciu).
    return float(((high_mm - low_mm) ** 2 / 4 + noise_mm2) * gap_px * 1.001)


@njit(cache=True, nogil=True, error_model="numpy")
def _hear(hit_du: Image, hit_dv: Image, hits: int, vote_sq: Number, near: Image) -> None:
    """Nearest samples of each pixel of a block of 4x4, in order: `near` has `SLOTS` rows of lanes.

    `hit_du` and `hit_dv` are float32 (hits,), pixels from the block's middle to each sample;
    `vote_sq` is how far a sample has a say, pixels squared. A sample is written as one number,
    squared distance before its place in the list: so sorting is nothing but minima and maxima, of
    all pixels at once.
    """
    near[:] = _NONE
    for i in range(hits):
        first_du, first_dv, place = hit_du[i] + _1, hit_dv[i] + _1, np.float32(i)
        for lane in range(_LANES):
            du, dv = first_du - np.float32(lane & 3), first_dv - np.float32(lane >> 2)
            squared = du * du + dv * dv
            key = squared * _4096 + place if squared <= vote_sq else _NONE
            for slot in range(SLOTS):
                old = near[slot * _LANES + lane]
                near[slot * _LANES + lane] = old if old < key else key
                key = key if old < key else old


@njit(cache=True, nogil=True, error_model="numpy")
def _spreads(near: Image, hit_mm: Image, weight_of: Image, voters: int, heard: Image) -> None:
    """Weight of the voters of each pixel of a block, and weighted variance of their depths, mm^2.

    `near` is what `_hear` wrote, `hit_mm` float32 (hits,) the depths of the samples. `heard`
    receives `_LANES` weights and as many variances; behind them, it is scratch.
    """
    for slot in range(voters):
        for lane in range(_USED_LANES):
            at = slot * _LANES + lane
            key, z, w = np.int32(near[at]), _0, _0
            if key < _NONE:
                z, w = hit_mm[key & 4095], weight_of[key >> 12]
            heard[2 * _LANES + at] = z
            heard[(2 + SLOTS) * _LANES + at] = w
    for lane in range(_LANES):
        weight, total, spread = _0, _0, _0
        for slot in range(SLOTS):
            at = 2 * _LANES + slot * _LANES + lane
            w = heard[SLOTS * _LANES + at]
            weight += w
            total += w * heard[at]
        mean = total / weight
        for slot in range(SLOTS):
            at = 2 * _LANES + slot * _LANES + lane
            off = heard[at] - mean
            spread += heard[SLOTS * _LANES + at] * (off * off)
        heard[lane] = weight
        heard[_LANES + lane] = spread / weight


class SampleIndex(NamedTuple):
    """What the kernel reads of `Samples`.

    Parameters
    ----------
    image_mm : float32 array of shape (H, W)
        Depth, `MISSED`, or 0 where nothing was measured.
    bits : uint64 array of shape (H, words)
        One bit per measured pixel, behind one word of zeros.
    tile_px, vote_px : int
        Side of the tiles, and how far a sample has a say, pixels.
    reach_px : float
        How far from a return a pixel may be shot, pixels.
    """

    image_mm: Image
    bits: npt.NDArray[np.uint64]
    tile_px: int
    vote_px: int
    reach_px: float


class StepRule(NamedTuple):
    """The score's parameters, and what they are looked up in by squared distance (pixels).

    Parameters
    ----------
    weight_of, length_of : float32 array of shape (distances,)
        A vote's weight, and the distance itself in pixels.
    half_of : int64 array of shape (distances,)
        The greatest whole number whose square is not above the squared distance.
    voters : int
        How many samples vote.
    gap_px, noise_mm2 : float
        Greatest gap that counts, pixels; variance where all agree, mm^2.
    """

    weight_of: Image
    length_of: Image
    half_of: npt.NDArray[np.int64]
    voters: int
    gap_px: float
    noise_mm2: float


class _Block(NamedTuple):
    """Working memory of one band: what is near a tile, a row of blocks, and a block."""

    tile_word: npt.NDArray[np.uint64]  # rows in reach of the tile: shots from left - vote_px on
    row_word: npt.NDArray[np.uint64]  # of those, the ones with shots in reach of a row of blocks
    row_dv: npt.NDArray[np.int64]  # and how far each is from the blocks' middles, pixels
    hit_du: Image  # samples near a block, from its middle, pixels
    hit_dv: Image
    hit_mm: Image
    miss_du: npt.NDArray[np.int64]  # shots near it that returned nothing
    miss_dv: npt.NDArray[np.int64]
    near_sq: npt.NDArray[np.int64]  # squared distances of the middle's voters
    near: Image  # see `_hear`
    heard: Image  # see `_spreads`


@njit(cache=True, nogil=True)
def _working_memory(index: SampleIndex, voters: int) -> _Block:
    room = (2 * index.vote_px + 3) ** 2
    return _Block(
        np.empty(index.tile_px + 2 * index.vote_px, np.uint64),
        np.empty(2 * index.vote_px + 3, np.uint64),
        np.empty(2 * index.vote_px + 3, np.int64),
        np.empty(room, np.float32),
        np.empty(room, np.float32),
        np.empty(room, np.float32),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty(voters + 1, np.int64),
        np.empty(SLOTS * _LANES, np.float32),
        np.zeros(2 * (1 + SLOTS) * _LANES, np.float32),
    )


@njit(cache=True, nogil=True, forceinline=True)
def _cut_out(index: SampleIndex, top: int, left: int, block: _Block) -> None:
    """Fill `block.tile_word` with the shots in reach of the tile at row `top`, column `left`."""
    start = left - index.vote_px + 64  # the padding's width in bits
    word, shift = start >> 6, np.uint64(start & 63)
    for i in range(index.tile_px + 2 * index.vote_px):
        y = top - index.vote_px + i
        block.tile_word[i] = 0
        if 0 <= y < index.image_mm.shape[0]:
            block.tile_word[i] = index.bits[y, word] >> shift
            if shift > 0:
                block.tile_word[i] |= index.bits[y, word + 1] << (np.uint64(64) - shift)


@njit(cache=True, nogil=True, forceinline=True)
def _rows_in_reach(row: int, vote_px: int, block: _Block) -> int:
    """List the rows with shots in reach of the blocks whose middles are `row` px below the top."""
    rows = 0  # the nearest first
    for step in range(2 * vote_px + 3):
        dv = (step + 1) // 2 if step & 1 else -(step // 2)
        found_word = block.tile_word[row + dv + vote_px]
        if found_word:
            block.row_word[rows], block.row_dv[rows] = found_word, dv
            rows += 1
    return rows


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _search(
    index: SampleIndex, rule: StepRule, v: int, u: int, column: int, rows: int, block: _Block
) -> tuple[int, int, Number, Number]:
    """Find what is near the block with its middle at row v, column u.

    Returns how many samples are in `block.hit_*`, how many misses in `block.miss_*`, and the least
    and greatest depth (mm) of the samples. `column` is the bit of the middle in
    the words.
    """
    one = np.uint64(1)
    voters, near_sq = rule.voters, block.near_sq
    search_sq = len(rule.half_of) - 1  # of the middle: for the voters of all the block's pixels
    farthest = search_sq
    hits = misses = found = 0
    # As voters are found, the window closes in on the block.
    for row in range(rows):
        dv = block.row_dv[row]
        if dv * dv > farthest:
            break
        half = rule.half_of[farthest - dv * dv]
        window = block.row_word[row] >> np.uint64(column - half)
        window &= (one << np.uint64(2 * half + 1)) - one
        while window:
            lowest = window & (~window + one)
            window ^= lowest
            du = _BIT_OF[(lowest * _DE_BRUIJN) >> np.uint64(58)] - half
            d = du * du + dv * dv
            if d > farthest:
                continue
            z = index.image_mm[v + dv, u + du]
            if z < 0:
                block.miss_du[misses], block.miss_dv[misses] = du, dv
                misses += 1
                continue
            block.hit_du[hits], block.hit_dv[hits], block.hit_mm[hits] = du, dv, z
            hits += 1
            if found < voters or d < near_sq[voters - 1]:
                at = min(found, voters - 1)
                while at > 0 and near_sq[at - 1] > d:
                    near_sq[at] = near_sq[at - 1]
                    at -= 1
                near_sq[at] = d
                found = min(found + 1, voters)
                if found == voters:
                    span = rule.length_of[near_sq[voters - 1]] + 2 * _CORNER_PX + 1e-6
                    farthest = min(search_sq, int(span * span))
    low, high = np.float32(np.inf), np.float32(0)
    kept = 0
    for i in range(hits):
        near_u, near_v, z = block.hit_du[i], block.hit_dv[i], block.hit_mm[i]
        if near_u * near_u + near_v * near_v <= farthest:
            block.hit_du[kept], block.hit_dv[kept], block.hit_mm[kept] = near_u, near_v, z
            kept += 1
            low, high = min(low, z), max(high, z)
    return kept, misses, low, high


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _score_block(
    index: SampleIndex, rule: StepRule, v: int, u: int, hits: int, misses: int, block: _Block,
    score: Image,
) -> Number:  # fmt: skip
    """Score the 3x3 pixels around row v, column u by what `_search` found; returns the best."""
    height, width = index.image_mm.shape
    near, heard = block.near, block.heard
    vote_sq, reach_sq = index.vote_px * index.vote_px, index.reach_px * index.reach_px
    most_gap_px, noise_sq = np.float32(rule.gap_px), np.float32(rule.noise_mm2)
    _hear(block.hit_du, block.hit_dv, hits, np.float32(vote_sq), near)
    _spreads(near, block.hit_mm, rule.weight_of, rule.voters, heard)
    best = np.float32(0)
    for y in range(v - 1, min(v + 2, height)):
        for x in range(u - 1, min(u + 2, width)):
            if index.image_mm[y, x] != 0:
                continue
            lane = (y - v + 1) * 4 + x - u + 1
            nearest_sq = int(near[lane]) >> 12
            if nearest_sq > reach_sq:
                continue
            second_sq = int(near[_LANES + lane]) >> 12
            if second_sq > vote_sq:
                second_sq = nearest_sq
            gap = (rule.length_of[nearest_sq] + rule.length_of[second_sq]) * _HALF
            s = (heard[_LANES + lane] + noise_sq) * min(gap, most_gap_px)
            if misses:
                farthest = min(vote_sq, int(near[(rule.voters - 1) * _LANES + lane]) >> 12)
                returned = all_weight = heard[lane]
                for i in range(misses):
                    du, dv = block.miss_du[i] + u - x, block.miss_dv[i] + v - y
                    d = du * du + dv * dv
                    if d <= farthest:
                        all_weight += rule.weight_of[d]
                s *= np.sqrt(returned / all_weight)
            score[y, x] = s
            best = max(best, np.float32(s))
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def score_tiles(
    first: int,
    end: int,
    tiles: npt.NDArray[np.int64],
    index: SampleIndex,
    rule: StepRule,
    least: float,
    score: Image,
    most: Image,
) -> None:
    """Score the pixels of some tiles that may be worth `least` or more.

    Blocks of 3x3 pixels share one search: around the middle, no pixel is farther than sqrt(2),
    so all its voters lie within the distance of the middle's last voter and twice that. If the
    depths found there are too alike for `least`, the block is done, and its scores are left 0.

    Parameters
    ----------
    first, end : int
        Which of `tiles` to score.
    tiles : int64 array of shape (n,)
        Tiles, numbered row by row.
    index : SampleIndex
        The samples.
    rule : StepRule
        The score.
    least : float
        Scores below may be left 0; mm^2 times pixels, as all scores.
    score : float32 array of shape (H, W)
        Filled in the tiles.
    most : float32 array of shape (tile rows, tile columns)
        Receives each tile's best score.
    """
    height, width = index.image_mm.shape
    tile_px, vote_px = index.tile_px, index.vote_px
    tile_columns = (width + tile_px - 1) // tile_px
    block = _working_memory(index, rule.voters)
    for k in range(first, end):
        top = tiles[k] // tile_columns * tile_px
        left = tiles[k] % tile_columns * tile_px
        _cut_out(index, top, left, block)
        best = np.float32(0)
        for v in range(top + 1, min(top + tile_px, height + 1), 3):
            rows = _rows_in_reach(v - top, vote_px, block)
            for u in range(left + 1, min(left + tile_px, width + 1), 3):
                score[v - 1 : min(v + 2, height), u - 1 : min(u + 2, width)] = 0
                column = u - left + vote_px
                hits, misses, low, high = _search(index, rule, v, u, column, rows, block)
                if hits == 0 or most_worth(low, high, rule.gap_px, rule.noise_mm2) < least:
                    continue
                found = _score_block(index, rule, v, u, hits, misses, block, score)
                best = max(best, np.float32(found))
        most[tiles[k] // tile_columns, tiles[k] % tile_columns] = best


@njit(cache=True, nogil=True)
def clear_tiles(score: Image, tiles: npt.NDArray[np.int64], tile_px: int) -> None:
    """Forget the scores of some tiles of `tile_px` pixels, numbered row by row."""
    tile_columns = (score.shape[1] + tile_px - 1) // tile_px
    for k in range(len(tiles)):
        top, left = tiles[k] // tile_columns * tile_px, tiles[k] % tile_columns * tile_px
        score[top : top + tile_px, left : left + tile_px] = 0


@njit(cache=True, nogil=True)
def tile_bounds(low_mm: Image, high_mm: Image, gap_px: float, noise_mm2: float) -> Image:
    """Upper bound of the score in each tile, from the depths near; -1 where there are none."""
    rows, columns = low_mm.shape
    bound = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            low, high = np.float32(np.inf), np.float32(0)
            for y in range(max(r - 1, 0), min(r + 2, rows)):
                for x in range(max(c - 1, 0), min(c + 2, columns)):
                    low = min(low, low_mm[y, x])
                    high = max(high, high_mm[y, x])
            bound[r, c] = -1 if low > high else most_worth(low, high, gap_px, noise_mm2)
    return bound
