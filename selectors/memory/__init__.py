"""Memory: a model over time, of which every frame measures a part."""

from selective_depth.selectors.memory.store import KEPT
from selective_depth.selectors.memory.temporal import TemporalAcquisition, TemporalStep
from selective_depth.selectors.memory.worth import Noise

__all__ = ["KEPT", "Noise", "TemporalAcquisition", "TemporalStep"]
