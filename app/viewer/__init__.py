"""The only room that knows Rerun: what is logged, how it is laid out, and where it goes."""

from selective_depth.app.viewer.screenshot import screenshot
from selective_depth.app.viewer.sinks import own_address
from selective_depth.app.viewer.stream import save_trainings
from selective_depth.app.viewer.viewer import Viewer
from selective_depth.app.viewer.web import free_port, serving_web_viewer, stream_port, web_address
from selective_depth.app.viewer.window import join_command

__all__ = [
    "Viewer",
    "free_port",
    "join_command",
    "own_address",
    "save_trainings",
    "screenshot",
    "serving_web_viewer",
    "stream_port",
    "web_address",
]
