"""The only room that knows Rerun: what is logged, how it is laid out, and where it goes."""

from selective_depth.app.viewer.recording import save_trainings, screenshot
from selective_depth.app.viewer.sinks import Viewer, has_display

__all__ = ["Viewer", "has_display", "save_trainings", "screenshot"]
