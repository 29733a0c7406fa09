"""Delaunay triangulation of pixels, grown point by point."""

from selective_depth.selectors.triangulation.delaunay import Mesh

__all__ = ["Mesh"]
