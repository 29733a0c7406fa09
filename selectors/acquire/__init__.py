"""Closing the loop: a budget of measurements, spent in rounds where the model is likely wrong."""

from selective_depth.selectors.acquire.loop import MOST_ROUNDS, Acquisition, acquire, best_selector, shots_of
from selective_depth.selectors.acquire.step import StepSelector
from selective_depth.selectors.acquire.surface import SurfaceSelector

__all__ = ["MOST_ROUNDS", "Acquisition", "StepSelector", "SurfaceSelector", "acquire", "best_selector", "shots_of"]
