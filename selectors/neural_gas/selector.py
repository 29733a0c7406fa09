"""Neural gas as a selector: train nodes on the seeds, read regions from them (section III)."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from selective_depth.selectors.arrays import Doubles, Floats
from selective_depth.selectors.nearby import nearest_points
from selective_depth.selectors.neural_gas.batch import BatchNeuralGas
from selective_depth.selectors.neural_gas.exact import train_exact
from selective_depth.selectors.neural_gas.regions import EdgeMetric, RegionSelection, check_edges, delaunay_regions
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selection

Algorithm = Literal["exact", "fast"]


@dataclass(eq=False)
class NeuralGasSelector:
    """Select regions by neural gas.

    `select` trains from nothing; `update` goes on from the last frame's nodes, whichever of the
    two has made them, as a live loop wants it (scikit-learn's `fit` and `partial_fit`). Several
    threads may `select` with one selector; of `update`, each stream of frames needs its own.

    Parameters
    ----------
    nodes : int, default 2800
        Number of nodes N (the paper: 1400 to 2800).
    epochs : int, default 50
        Training length of ``exact`` in passes over the seeds (the paper's best: 40-60). Batch
        training converges by itself and does not use it.
    algorithm : {"fast", "exact"}, default "fast"
        How `select` trains: ``exact`` takes the published steps one by one, ``fast`` batch passes
        that reach a lower quantisation error in a fiftieth of the time on scenes (on depth without
        any structure, 3.4 % more).
    seed : int, default 0
        Seed of the random draws; equal seeds give equal selections.
    edge_metric : {"3d", "image"}, default "3d"
        Where the edges of the triangulation are measured.
    factor : float, default 1.0
        Threshold as a multiple of the mean edge; 1 is the paper's.
    threads : int, optional
        Threads of the batch training; default one per processor.

    Raises
    ------
    ValueError
        If a parameter is not allowed, saying what is.

    Examples
    --------
    >>> import numpy as np
    >>> wall_mm = np.full((48, 64), 2000, np.uint16)
    >>> wall_mm[16:32, 20:44] = 1200  # a box before it
    >>> seeds = SeedGrid.from_array(wall_mm, (24, 32))
    >>> selection = NeuralGasSelector(nodes=100).select(seeds)
    >>> selection.nodes_mm.shape, selection.mask.shape
    ((100, 3), (48, 64))

    References
    ----------
    Payeur, Curtis, Cretu, "Computational Methods for Selective Acquisition of Depth Measurements
    in Machine Perception", section III, eq. (1)-(4).
    """

    nodes: int = 2800
    epochs: int = 50
    algorithm: Algorithm = "fast"
    seed: int = 0
    edge_metric: EdgeMetric = "3d"
    factor: float = 1.0
    threads: int | None = None
    name = "neural gas"

    def __post_init__(self) -> None:
        for good, name, allowed in (
            (self.nodes >= 1, "nodes", "give at least 1, the paper takes 1400 to 2800"),
            (self.epochs >= 1, "epochs", "give at least 1, the paper's best is 40 to 60"),
            (self.algorithm in ("exact", "fast"), "algorithm", "give 'exact' or 'fast'"),
            (self.seed >= 0, "seed", "give 0 or more"),
        ):
            if not good:
                raise ValueError(f"{name} is {getattr(self, name)!r}; {allowed}")
        check_edges(self.edge_metric, self.factor)
        self._live = self._untrained()
        self._updating = threading.Lock()

    def select(self, samples: SeedGrid | Samples) -> RegionSelection:
        """Train from nothing on the samples of one frame.

        Raises
        ------
        ValueError
            If a sample that returned depth has no finite metric point, or the samples have neither
            a camera nor metric points.
        """
        points, uv = _finite_points(samples), samples.uv
        gas = self._untrained()
        if len(points) == 0:
            return self._regions(gas, samples)
        if self.algorithm == "fast":
            gas.train(points, uv)
        else:
            nodes_mm = train_exact(points, self.nodes, self.epochs, self.seed)
            gas.adopt(nodes_mm, node_pixels(nodes_mm, samples), points)
        regions = self._regions(gas, samples)
        self._live = gas
        return regions

    def update(self, samples: SeedGrid | Samples) -> RegionSelection:
        """Go on from the nodes of the last frame, by batch passes; without one, train cold by them.

        Raises
        ------
        ValueError
            If a sample that returned depth has no finite metric point, or the samples have neither
            a camera nor metric points.
        RuntimeError
            If another thread is updating the same nodes.
        """
        points, uv = _finite_points(samples), samples.uv
        if len(points) == 0:
            return self._regions(self._untrained(), samples)
        if not self._updating.acquire(blocking=False):
            raise RuntimeError(
                "another thread is updating this NeuralGasSelector; give each stream of frames a selector of its own"
            )
        try:
            return self._regions(self._live.update(points, uv), samples)
        finally:
            self._updating.release()

    def _untrained(self) -> BatchNeuralGas:
        return BatchNeuralGas(self.nodes, self.seed, self.threads)

    def _regions(self, gas: BatchNeuralGas, samples: SeedGrid | Samples) -> RegionSelection:
        camera = samples.camera
        nodes_mm = gas.nodes_mm_[gas.won_]
        return delaunay_regions(
            nodes_mm,
            gas.nodes_uv_[gas.won_] if camera is None else camera.project_uv(nodes_mm),
            samples.frame_shape,
            edge_metric=self.edge_metric,
            factor=self.factor,
            quantisation_error_mm=gas.quantisation_error_mm_,
        )


@dataclass(frozen=True)
class LongEdgeSelector:
    """Select by the long-edge complement of a neural gas: the project's own read-out.

    Parameters
    ----------
    gas : NeuralGasSelector, optional
        Trains the nodes; its selection's `RegionSelection.long_edges` is read.
    """

    gas: NeuralGasSelector = field(default_factory=NeuralGasSelector)
    name = "neural gas, long edges"

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Train from nothing, and rank the triangles that do not survive by their longest edge."""
        return self.gas.select(samples).long_edges()


def node_pixels(nodes_mm: Floats, samples: SeedGrid | Samples) -> Floats:
    """Pixels (column, row) on which nodes fall.

    Parameters
    ----------
    nodes_mm : float32 array of shape (N, 3)
        Nodes in millimetres.
    samples : SeedGrid or Samples
        What they were trained on. With a camera the nodes are projected; without one, each
        takes the mean pixel of the four samples nearest to it, the nearer the heavier.

    Returns
    -------
    float32 array of shape (N, 2)
    """
    if samples.camera is not None:
        return samples.camera.project_uv(nodes_mm)
    distance, index = nearest_points(samples.points_mm, nodes_mm, 4)
    uv = samples.uv[index]
    weight = 1 / (distance + 1e-3)
    # Neighbours in space may lie at both ends of a panorama's rows: no mean over the seam.
    weight[np.abs(uv[..., 0] - uv[:, :1, 0]) > samples.frame_shape[1] / 4] = 0
    mean: Doubles = (uv * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None]
    return mean.astype(np.float32)


def _finite_points(samples: SeedGrid | Samples) -> Floats:
    points = samples.points_mm
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise ValueError(
            f"{bad} of {len(points)} samples have depth but no finite metric point; set their depth"
            " to 0 (no measurement) or give finite points"
        )
    return points
