"""The dense model of the samples so far, kept while more come.

A round of measurements touches a small part of a frame. So the triangulation, the nearest sample
of every pixel and the model drawn from them are kept, and a batch of new samples costs what it
changes: the triangles of the new points' stars are drawn again, and the pixels that lie nearest to
a new sample are told so. The result is that of `selectors.reconstruct`, whatever the batches
were; but for a pixel, once in many frames, whose nearest samples are a dozen pixels off and alike.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats, Ints
from selective_depth.selectors.parallel import at_once, in_bands
from selective_depth.selectors.triangulation.delaunay import Mesh
from selective_depth.selectors.triangulation.draw import (
    TILE_PX,
    Layers,
    change_about,
    change_within,
    draw,
    sort_out,
    touch,
)
from selective_depth.selectors.triangulation.nearest import FAR_SQ, nearest_sample

MANY = 1000
"""More triangles or points than this are worth a second thread."""


_THIN_PX = 5
"""For so many rows that a region is high it is looked for in one more beyond its end. Farther than a
dozen pixels from all samples, it may pass between the pixels of a row."""


@njit(cache=True, nogil=True)
def _take_in(
    uv: Ints, depth_mm: Floats, samples_mm: Floats, point: Ints, first: int, kept_uv: Ints, kept_mm: Floats
) -> int:
    """Book the samples that returned, numbered from `first` on, and list them; how many is returned."""
    count = 0
    for i in range(len(uv)):
        if depth_mm[i] > 0:
            u, v = uv[i]
            samples_mm[v, u] = kept_mm[count] = depth_mm[i]
            kept_uv[count, 0], kept_uv[count, 1], point[v, u] = u, v, first + count
            count += 1
    return count


@njit(cache=True, nogil=True, inline="always")
def _nearer(gap_sq: Ints, nearest: Ints, v: int, u: int, v0: int, u0: int) -> bool:
    """Is a pixel nearer to the sample at (u0, v0) than to its nearest? Of two, the left or upper one is."""
    here_sq, known_sq = (u - u0) * (u - u0) + (v - v0) * (v - v0), gap_sq[v, u]
    if here_sq != known_sq:
        return bool(here_sq < known_sq)
    row, column = nearest[v, u] // gap_sq.shape[1], nearest[v, u] % gap_sq.shape[1]
    return bool(u0 < column or (u0 == column and v0 < row))


@njit(cache=True, nogil=True)
def _claim(layers: Layers, uv: Ints) -> None:
    """Give every new sample the pixels that lie nearer to it than to any other.

    They form a convex region about the sample: in each row one run, which touches that of the row
    before.
    """
    samples_mm, nearest, gap_sq, depth_mm, plain, _, touched = layers
    height, width = gap_sq.shape
    for i in range(len(uv)):
        u0, v0 = uv[i, 0], uv[i, 1]
        name = v0 * width + u0
        z = samples_mm[v0, u0]
        for direction in (-1, 1):
            left, right, passed = u0, u0, 0
            v = v0 if direction < 0 else v0 + 1
            while 0 <= v < height:
                first, last = max(left - 1, 0), min(right + 1, width - 1)
                while first <= last and not _nearer(gap_sq, nearest, v, first, v0, u0):
                    first += 1
                if first > last:
                    if passed == abs(v - v0) // _THIN_PX:
                        break
                    passed, left, right, v = passed + 1, left - 1, right + 1, v + direction
                    continue
                while not _nearer(gap_sq, nearest, v, last, v0, u0):
                    last -= 1
                while first > 0 and _nearer(gap_sq, nearest, v, first - 1, v0, u0):
                    first -= 1
                while last < width - 1 and _nearer(gap_sq, nearest, v, last + 1, v0, u0):
                    last += 1
                for u in range(first, last + 1):
                    gap_sq[v, u] = (u - u0) * (u - u0) + (v - v0) * (v - v0)
                    nearest[v, u] = name
                    if not plain[v, u]:
                        depth_mm[v, u] = z
                touch(touched, v, first, v, last)
                left, right = first, last
                v += direction


@njit(cache=True, nogil=True)
def _draw_far(layers: Layers) -> None:
    """Draw what is not linear: as the nearest sample, whatever has become of that."""
    samples_mm, nearest, _, depth_mm, plain, _, touched = layers
    height, width = depth_mm.shape
    for v in range(height):
        for u in range(width):
            name = nearest[v, u]
            if plain[v, u]:
                continue
            z = samples_mm[name // width, name % width] if name >= 0 else np.float32(0)
            if depth_mm[v, u] != z:
                depth_mm[v, u] = z
                touch(touched, v, u, v, u)


class Surface:
    """A dense model that samples can be added to.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image in pixels.
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.

    Attributes
    ----------
    layers : Layers
        What is known at every pixel. They are the surface's own: read them, and copy what is to
        outlast the next `add`.
    """

    def __init__(self, shape: tuple[int, int], threads: int | None = None) -> None:
        self._threads = threads
        self.layers = Layers(
            samples_mm=np.zeros(shape, np.float32),
            nearest=np.full(shape, -1, np.int32),
            gap_sq=np.full(shape, FAR_SQ, np.int32),
            depth_mm=np.zeros(shape, np.float32),
            plain=np.zeros(shape, np.bool_),
            spread_mm2=np.zeros(shape, np.float32),
            touched=np.ones(tuple(-(-pixels // TILE_PX) for pixels in shape), np.bool_),
        )
        self._uv = np.empty((0, 2), np.int32)
        self._depth_mm = np.empty(0, np.float32)
        self._point = np.full(shape, -1, np.int32)
        self._mesh: Mesh | None = None
        self._kind = np.empty(0, np.uint8)  # of every triangle

    @property
    def points(self) -> int:
        """How many samples it holds."""
        return len(self._uv)

    def add(self, uv: Ints, depth_mm: Floats) -> None:
        """Take in samples: pixels (n, 2), column first, none given before, and depth (n,) in mm.

        Those without depth (0 or negative) are left out.
        """
        self._insert(uv, depth_mm)
        self._draw_changed()

    def put(self, uv: Ints, depth_mm: Floats) -> None:
        """As `add`, but some of the pixels may have been given before: they get another depth."""
        point = self._point[uv[:, 1], uv[:, 0]]
        again = (point >= 0) & (depth_mm > 0)
        u, v = uv[again, 0], uv[again, 1]
        differ = depth_mm[again] != self.layers.samples_mm[v, u]
        if differ.any():
            self._depth_mm[point[again]] = self.layers.samples_mm[v, u] = depth_mm[again]
            if self._mesh is not None:
                other = np.zeros(len(self._uv) + 1, np.bool_)  # and one for the ghost, which is -1
                other[point[again][differ]] = True
                mesh = self._mesh
                change_about(other, mesh.tri[: mesh.triangles], mesh.changed)
        self._insert(uv[point < 0], depth_mm[point < 0])
        self._draw_changed()
        if differ.any():
            _draw_far(self.layers)

    def remove(self, uv: Ints) -> None:
        """Take samples out again: pixels (n, 2), column first; those that are no sample are passed over."""
        gone = self._point[uv[:, 1], uv[:, 0]]
        gone = np.unique(gone[gone >= 0])
        if not len(gone):
            return
        layers = self.layers
        u, v = self._uv[gone].T
        self._point[v, u], layers.samples_mm[v, u] = -1, 0
        self._uv, self._depth_mm = np.delete(self._uv, gone, axis=0), np.delete(self._depth_mm, gone)
        self._point[self._uv[:, 1], self._uv[:, 0]] = np.arange(len(self._uv))
        layers.nearest[:], layers.gap_sq[:] = nearest_sample(layers.samples_mm > 0, self._threads)
        mesh = self._mesh
        box_px = mesh.remove(gone) if mesh is not None and len(gone) <= len(self._uv) else None
        if mesh is None or box_px is None:
            self._mesh = Mesh.of(self._uv, 2 * len(self._uv), layers.depth_mm.shape)
            layers.plain[:], layers.spread_mm2[:] = False, 0
        else:  # within the box some of what lay inside the hull may lie outside
            left, right, top, bottom = box_px
            box = slice(top, bottom + 1), slice(left, right + 1)
            layers.plain[box], layers.spread_mm2[box] = False, 0
            change_within(box_px, mesh.uv, mesh.tri[: mesh.triangles], mesh.changed)
        self._draw_changed()
        _draw_far(layers)
        layers.touched[:] = True

    def _insert(self, uv: Ints, depth_mm: Floats) -> None:
        """Take in samples without drawing them."""
        returned = np.empty((len(uv), 2), np.int32), np.empty(len(uv), np.float32)
        count = _take_in(uv, depth_mm, self.layers.samples_mm, self._point, len(self._uv), *returned)
        if not count:
            return
        uv = returned[0][:count]
        self._uv = np.concatenate((self._uv, uv))
        self._depth_mm = np.concatenate((self._depth_mm, returned[1][:count]))
        at_once(partial(self._tell_nearest, uv), partial(self._triangulate, uv), threads=self._threads_for(len(uv)))

    def _threads_for(self, work: int) -> int | None:
        """To begin a thread takes as long as some hundred triangles or points."""
        return self._threads if work > MANY else 1

    def _tell_nearest(self, uv: Ints) -> None:
        """Tell every pixel which sample is nearest."""
        layers = self.layers
        if len(uv) < len(self._uv):
            _claim(layers, uv)
        else:  # one by one, the first of many samples would claim whole images
            layers.nearest[:], layers.gap_sq[:] = nearest_sample(layers.samples_mm > 0, 1)
            np.take(layers.samples_mm, layers.nearest, out=layers.depth_mm, mode="clip")
            layers.touched[:] = True

    def _triangulate(self, uv: Ints) -> None:
        """Take new points into the mesh."""
        if self._mesh is None:
            self._mesh = Mesh.of(self._uv, 2 * len(self._uv), self.layers.depth_mm.shape)
        else:
            self._mesh.add(uv)

    def _draw_changed(self) -> None:
        """Draw the triangles that were made or reshaped, or whose corners have another depth."""
        mesh, layers = self._mesh, self.layers
        if mesh is None:  # nothing, or all on one line
            return
        if len(self._kind) < len(mesh.tri):  # it has grown
            self._kind = np.pad(self._kind, (0, len(mesh.tri) - len(self._kind)))
        drawn = np.empty(mesh.triangles, np.int32)
        points = mesh.uv, self._depth_mm
        count = sort_out(mesh.changed[: mesh.triangles], *points, mesh.tri, self._kind, drawn)
        flat = Layers._make((*(layer.ravel() for layer in layers[:-1]), layers.touched))
        width = layers.depth_mm.shape[1]
        triangles = mesh.tri, mesh.adj, self._kind
        in_bands(draw, count, self._threads_for(count), drawn, flat, width, points, triangles)
