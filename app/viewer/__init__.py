"""The only room that knows Rerun: what is logged, how it is laid out, and where it goes."""

from selective_depth.app.viewer.screenshot import screenshot
from selective_depth.app.viewer.stream import save_trainings
from selective_depth.app.viewer.viewer import Viewer
from selective_depth.app.viewer.window import has_display, join_command

__all__ = ["Viewer", "has_display", "join_command", "save_trainings", "screenshot"]
