"""One frame's way: a frame in; seeds, both selectors, the samples and the model out."""

from selective_depth.app.pipeline.loop import Loop
from selective_depth.app.pipeline.report import (
    RunReport,
    count_samples,
    is_settings,
    print_report,
    save_settings,
    say,
)
from selective_depth.app.pipeline.result import Arrival, Model, StateNote, Step
from selective_depth.app.pipeline.timing import STAGES, StageSummary, StageTimes

__all__ = [
    "STAGES",
    "Arrival",
    "Loop",
    "Model",
    "RunReport",
    "StageSummary",
    "StageTimes",
    "StateNote",
    "Step",
    "count_samples",
    "is_settings",
    "print_report",
    "save_settings",
    "say",
]
