"""The demo page: the viewer in a browser, with controls beside it."""

from selective_depth.app.demo.demo import run_demo

__all__ = ["run_demo"]
