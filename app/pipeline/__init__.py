"""One frame's way: a frame in; seeds, both selectors, the samples and the model out."""

from selective_depth.app.pipeline.feed import Feed, open_and_tell, state_of
from selective_depth.app.pipeline.governor import Governor
from selective_depth.app.pipeline.pipeline import Pipeline
from selective_depth.app.pipeline.report import (
    Mean,
    RunReport,
    gain_of,
    is_settings,
    mean_of,
    print_report,
    save_settings,
    say,
    write_if_asked,
)
from selective_depth.app.pipeline.result import FrameResult, Model, SensorNote, figures_of
from selective_depth.app.pipeline.selecting import SELECTOR_NAMES, gas_of, improvement_of, selector_of
from selective_depth.app.pipeline.timing import STAGES, StageSummary, StageTimes

__all__ = [
    "SELECTOR_NAMES",
    "STAGES",
    "Feed",
    "FrameResult",
    "Governor",
    "Mean",
    "Model",
    "Pipeline",
    "RunReport",
    "SensorNote",
    "StageSummary",
    "StageTimes",
    "figures_of",
    "gain_of",
    "gas_of",
    "improvement_of",
    "is_settings",
    "mean_of",
    "open_and_tell",
    "print_report",
    "save_settings",
    "say",
    "selector_of",
    "state_of",
    "write_if_asked",
]
