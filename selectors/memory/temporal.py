"""A model over time: what was measured stays known, and each frame's budget goes where it helps.

The first frame is a plain acquisition. From then on a frame's budget is spent on look-outs, which
measure a part of the seed lattice again, in turn, and say what has changed; on the outlines of what
has; and on the pixels, new or known, where a shot is expected to remove most error. Nothing is
known that was not asked for.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera
from selective_depth.selectors.acquire import acquire, shots_of
from selective_depth.selectors.arrays import Bools, Bytes, Floats, Ints, pixels_where
from selective_depth.selectors.choice import best_pixels
from selective_depth.selectors.memory.change import (
    BESIDE,
    MARGIN_PX,
    MOVED,
    NEAR_PX,
    Extent,
    around,
    contradicts,
    drift,
)
from selective_depth.selectors.memory.store import Memory, book, forget, forget_all
from selective_depth.selectors.memory.worth import Noise, shot_worth, wrong
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import REACH, Samples, seed_pitch_px
from selective_depth.selectors.seeds import Measure, SeedGrid, answers
from selective_depth.selectors.selection import Selector, Worth, plan_of
from selective_depth.selectors.triangulation import TILE_PX, Surface

CALM_LOOKS, ALERT_LOOKS = 0.15, 0.3
"""Share of a frame's budget that looks out, in a still scene and for `ALERT_FRAMES` after a
change."""
ALERT_FRAMES = 3
EXTENT_ROUNDS = 3
"""Rounds of shots along the border of what has changed."""
MOST_LOST = 1000
"""Points of the mesh that stand in holes by now, before they are taken out of it."""
PROBATION = 8
"""Frames without a sign of motion before the memory is relied on, where the budget pays for a fresh
start in every frame: a hand may hold a camera still for a moment."""
FEWEST_CONFIRMED = 2
"""Of four shots about a contradiction, so many must contradict as well."""


@dataclass(frozen=True, eq=False)
class TemporalStep:
    """What one frame added to the memory.

    Parameters
    ----------
    frame : int
        Its number, from 0.
    uv : int32 array of shape (n, 2)
        Pixels measured in it, column first, each once.
    depth_mm : float32 array of shape (n,)
        Their depth; 0 = no return.
    batch : uint8 array of shape (n,)
        In which order: 0 = look-outs, or the seeds of a first frame.
    model_mm : float32 array of shape (H, W)
        Dense depth of all that is known.
    known_mm : float32 array of shape (H, W)
        What each known pixel has been fused to; 0 where not known.
    seeds : SeedGrid
        The lattice as it is known, for the selectors that think in its cells.
    known : bool array of shape (H, W)
        Pixels that have been measured, in this frame or before, and not been forgotten.
    age_frames : int32 array of shape (H, W)
        Frames since each of them was measured last; -1 where not known.
    changed : bool array of shape (H, W)
        What was forgotten in this frame: where it contradicted the memory, and a margin.
    restarted : bool
        Whether all of it was: in the first frame, after a cut, or because the camera moved.
    settled : bool
        Whether the model is the memory's; else it is of this frame's measurements alone.
    by : str
        Name of the selector that chose new pixels.
    """

    frame: int
    uv: Ints
    depth_mm: Floats
    batch: Bytes
    model_mm: Floats
    known_mm: Floats
    seeds: SeedGrid
    known: Bools
    age_frames: Ints
    changed: Bools
    restarted: bool
    settled: bool
    by: str


class _Sensor:
    """The sensor during one frame: it is asked for a pixel once, and what it said is kept."""

    def __init__(self, measure: Measure, shape: tuple[int, int]) -> None:
        self._measure = measure
        self._answer_mm = np.full(shape, np.nan, np.float32)
        self.uv: list[Ints] = []
        self.depth_mm: list[Floats] = []

    def __call__(self, uv: npt.NDArray[np.integer]) -> Floats:
        """Depth of pixels (n, 2), column first; 0 = no return."""
        u, v = uv[:, 0], uv[:, 1]
        new = np.isnan(self._answer_mm[v, u])
        if new.any():
            asked = np.ascontiguousarray(uv[new], np.int32)
            _, mm = answers(self._measure, asked)
            self._answer_mm[asked[:, 1], asked[:, 0]] = mm
            self.uv.append(asked)
            self.depth_mm.append(mm)
        found: Floats = self._answer_mm[v, u]
        return found

    def unasked(self, uv: Ints) -> Ints:
        """Those of some pixels that were not asked for yet."""
        found: Ints = uv[np.isnan(self._answer_mm[uv[:, 1], uv[:, 0]])]
        return found

    @property
    def spent(self) -> int:
        """Measurements made in this frame."""
        return sum(map(len, self.uv))


@dataclass(eq=False)
class TemporalAcquisition:
    """Acquire frame after frame, and remember.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frames.
    budget : float, default 0.02
        All measurements of a frame after the first, as a share of its pixels.
    first_budget : float, default 0.05
        Measurements of a first frame beyond its seeds: of the very first, and of one in which
        everything has changed. Such a frame takes no less than `budget` in all.
    seeds : tuple of int, default (128, 128)
        Rows and columns of the seed lattice.
    rounds : int, default 4
        Rounds of a first frame, and of what has changed.
    selector : Selector or callable, optional
        Chooses the new pixels; known ones are measured again by what that is worth (`shot_worth`).
        By default that worth decides between new and known ones alike.
    noise : Noise, optional
        Of the sensor; default a Kinect's.
    camera : Camera, optional
        Intrinsics; by default a pinhole with a Kinect's field of view is assumed.
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.

    Raises
    ------
    ValueError
        If a budget or the lattice is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> wall_mm = np.full((96, 128), 2000, np.uint16)
    >>> memory = TemporalAcquisition((96, 128), seeds=(24, 32))
    >>> for _ in range(3):
    ...     step = memory.step(lambda uv: wall_mm[uv[:, 1], uv[:, 0]])
    >>> len(step.uv), int(step.known.sum()) >= 1382
    (246, True)
    """

    shape: tuple[int, int]
    _: KW_ONLY
    budget: float = 0.02
    first_budget: float = 0.05
    seeds: tuple[int, int] = (128, 128)
    rounds: int = 4
    selector: Selector | Worth | None = None
    noise: Noise = field(default_factory=Noise)
    camera: Camera | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        self._shots = shots_of(self.budget, self.shape)
        self._first_shots = shots_of(self.first_budget, self.shape)
        self._grid = SeedGrid.from_array(np.zeros(self.shape, np.uint16), self.seeds, camera=self.camera)
        lattice = self._grid.lattice_uv.reshape(-1, 2)
        # In an order of which every part is spread over the frame.
        self._lattice_uv = lattice[np.random.default_rng(0).permutation(len(lattice))]
        self._looked = 0
        self._pitch_px = seed_pitch_px(self._grid)
        self._reach_sq = (REACH * self._pitch_px) ** 2
        self._frame = -1
        self._alert = 0
        # Where a frame's budget does not pay for a fresh start, the memory is relied on at once.
        affordable = self._shots >= len(lattice) + self._first_shots
        self._probation = PROBATION if affordable else 0
        self._still = 0
        self._memory = Memory.of(self.shape)
        self._surface = Surface(self.shape, self.threads)
        self._worth = np.empty(self.shape, np.float32)
        self._wrong = wrong()
        self._by = ""

    def step(self, measure: Measure) -> TemporalStep:
        """Spend one frame's budget.

        Parameters
        ----------
        measure : callable
            The sensor, as it sees the frame: pixels (n, 2), column first, to depth (n,) in
            millimetres, 0 = no return. No pixel is asked for twice.

        Raises
        ------
        ValueError
            If the sensor does not answer with one depth per pixel.
        """
        self._frame += 1
        self._alert = max(self._alert - 1, 0)
        sensor = _Sensor(measure, self.shape)
        changed = self._look_out(sensor) if self._frame else None
        restarted = changed is None
        self._still = 0 if restarted else self._still + 1
        if changed is None:
            forget_all(self._memory)
            changed = np.ones(self.shape, np.bool_)
        settled = self._probation < self._still  # never after a restart
        if settled:
            moved = bool(changed.any())
            if moved:
                self._alert = ALERT_FRAMES
                forget(self._memory, changed)
                self._surface.remove(pixels_where(changed))
            self._book(sensor, 0)
            self._surface.layers.touched[:] = True  # all has aged by a frame
            for left in range(self.rounds if moved else 1, 0, -1):
                self._measure_best(sensor, (self._shots - sensor.spent) // left)
            model_mm = self._surface.layers.depth_mm.copy()
        else:
            model_mm = self._start(sensor, restarted)
        known = self._memory.held > 0
        return TemporalStep(
            frame=self._frame,
            uv=np.concatenate(sensor.uv),
            depth_mm=np.concatenate(sensor.depth_mm),
            batch=np.repeat(np.minimum(np.arange(len(sensor.uv)), 255).astype(np.uint8), [len(uv) for uv in sensor.uv]),
            model_mm=model_mm,
            known_mm=self._memory.fused_mm.copy(),
            seeds=replace(self._grid, depth_mm=self._memory.fused_mm[np.ix_(self._grid.rows, self._grid.columns)]),
            known=known,
            age_frames=np.where(known, self._frame - self._memory.asked, -1).astype(np.int32),
            changed=changed,
            restarted=restarted,
            settled=settled,
            by=self._by,
        )

    def _look_out(self, sensor: _Sensor) -> Bools | None:
        """Look where anything is not as it was, shape (H, W); None if nothing is as it was."""
        share = ALERT_LOOKS if self._alert else CALM_LOOKS
        count = min(round(share * self._shots), len(self._lattice_uv))
        turn = (self._looked + np.arange(count)) % len(self._lattice_uv)
        self._looked += count
        uv = self._lattice_uv[turn]
        mm = sensor(uv)
        model_mm = self._surface.layers.depth_mm
        against = contradicts(uv, mm, model_mm)
        z = model_mm[uv[:, 1], uv[:, 0]]
        noise_mm = self.noise.floor_mm + self.noise.per_mm * z * z
        if drift(uv, mm, model_mm, noise_mm) > MOVED:
            return None
        if not against.any():
            return np.zeros(self.shape, np.bool_)
        doubted = uv[against]
        beside = around(doubted, self.shape)[: self._shots - sensor.spent]
        beside_against = contradicts(beside, sensor(beside), model_mm)
        votes = np.zeros(self.shape, np.uint8)
        votes[beside[beside_against, 1], beside[beside_against, 0]] = 1
        at = doubted[:, None] + BESIDE + NEAR_PX
        confirmed = np.pad(votes, NEAR_PX)[at[..., 1], at[..., 0]].sum(axis=1) >= FEWEST_CONFIRMED
        if not confirmed.any():
            return np.zeros(self.shape, np.bool_)
        extent = Extent(self.shape, self.threads)
        extent.add(uv, against)
        extent.add(beside, beside_against)
        extent.add(doubted, confirmed)
        for left in range(EXTENT_ROUNDS, 0, -1):
            _, border_px = extent.changed()
            shots = (self._shots - sensor.spent) // (left + 1)
            new = sensor.unasked(best_pixels(border_px, shots))
            extent.add(new, contradicts(new, sensor(new), model_mm))
        where, _ = extent.changed()
        return cv2.dilate(where.view(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).view(np.bool_)

    def _start(self, sensor: _Sensor, restarted: bool) -> Floats:
        """Acquire the frame as if it were the first, and return the model of it alone."""
        seeds = SeedGrid.measured(sensor, self.shape, self._grid.shape, camera=self._grid.camera)
        shots = max(self._first_shots, self._shots - len(self._lattice_uv))
        acquisition = acquire(
            sensor, seeds, rounds=self.rounds, selector=self.selector, shots=shots, threads=self.threads
        )
        self._by = acquisition.by
        model_mm = acquisition.reconstruct(self.threads)
        if restarted:  # what is known is what the acquisition has measured, and its plan may have the model of that
            self._surface = acquisition.plan.surface if acquisition.plan else Surface(self.shape, self.threads)
        self._book(sensor, 0)
        return model_mm

    def _book(self, sensor: _Sensor, first: int) -> None:
        """Take in this frame's answers from number `first` on, and draw the model."""
        uv = np.concatenate([np.empty((0, 2), np.int32), *sensor.uv[first:]])
        mm = np.concatenate([np.empty(0, np.float32), *sensor.depth_mm[first:]])
        book(self._memory, uv, mm, self._frame)
        self._surface.put(uv, self._memory.fused_mm[uv[:, 1], uv[:, 0]])
        self._surface.layers.touched[uv[:, 1] // TILE_PX, uv[:, 0] // TILE_PX] = True
        if self._surface.points - np.count_nonzero(self._memory.held) > MOST_LOST:
            self._surface.remove(pixels_where(self._memory.held == 0))

    def _measure_best(self, sensor: _Sensor, shots: int) -> None:
        """Measure the pixels that are worth most, and draw what comes of it."""
        if shots <= 0:
            return
        worth, layers, noise = self._worth, self._surface.layers, (self.noise.floor_mm, self.noise.per_mm)
        tiles = np.flatnonzero(layers.touched)
        layers.touched[:] = False
        what = tiles, self._memory, layers, self._reach_sq, noise, self._frame, self._wrong, worth
        in_bands(shot_worth, len(tiles), self.threads, *what)
        first = len(sensor.uv)
        if self.selector is not None:
            samples = Samples(self.shape, self._pitch_px)
            held = self._memory.held > 0
            samples.add(pixels_where(held), self._memory.fused_mm[held])
            new = plan_of(self.selector, samples).best(shots // 2)
            sensor(sensor.unasked(new))
            worth = np.where(self._memory.held > 0, worth, np.float32(0))
            shots -= shots // 2
        sensor(best_pixels(worth, shots))
        self._book(sensor, first)
