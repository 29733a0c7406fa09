"""The improvement map (section IV), derived from ordinary kriging."""

from selective_depth.selectors.improvement.scattered import improvement_scattered
from selective_depth.selectors.improvement.selector import ImprovementSelection, ImprovementSelector

__all__ = ["ImprovementSelection", "ImprovementSelector", "improvement_scattered"]
