"""One frame's way: a frame in; seeds, both selectors, the samples and the model out."""

from selective_depth.app.pipeline.feed import Feed, open_and_tell
from selective_depth.app.pipeline.governor import Governor
from selective_depth.app.pipeline.pipeline import Pipeline
from selective_depth.app.pipeline.report import RunReport, print_report, say
from selective_depth.app.pipeline.result import FrameResult, Model, SensorNote, figures_of
from selective_depth.app.pipeline.timing import STAGES, StageSummary, StageTimes

__all__ = [
    "STAGES",
    "Feed",
    "FrameResult",
    "Governor",
    "Model",
    "Pipeline",
    "RunReport",
    "SensorNote",
    "StageSummary",
    "StageTimes",
    "figures_of",
    "open_and_tell",
    "print_report",
    "say",
]
