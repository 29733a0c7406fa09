"""One frame's way: a frame in; seeds, both selectors, the samples and the model out."""

from selective_depth.app.pipeline.feed import Feed, Read, open_and_tell, state_of
from selective_depth.app.pipeline.figures import figures_of
from selective_depth.app.pipeline.pipeline import Pipeline
from selective_depth.app.pipeline.report import RunReport, is_settings, print_report, save_settings, say
from selective_depth.app.pipeline.result import FrameResult, Model, SensorNote
from selective_depth.app.pipeline.timing import STAGES, StageSummary, StageTimes

__all__ = [
    "STAGES",
    "Feed",
    "FrameResult",
    "Model",
    "Pipeline",
    "Read",
    "RunReport",
    "SensorNote",
    "StageSummary",
    "StageTimes",
    "figures_of",
    "is_settings",
    "open_and_tell",
    "print_report",
    "save_settings",
    "say",
    "state_of",
]
