"""Delaunay triangulation of pixels, grown point by point, and the surface drawn from it."""

from selective_depth.selectors.triangulation.delaunay import Mesh
from selective_depth.selectors.triangulation.draw import BRIDGE_PX, STEP_MM, TILE_PX, Layers
from selective_depth.selectors.triangulation.nearest import FAR_SQ, nearest_sample
from selective_depth.selectors.triangulation.surface import Surface

__all__ = ["BRIDGE_PX", "FAR_SQ", "STEP_MM", "TILE_PX", "Layers", "Mesh", "Surface", "nearest_sample"]
