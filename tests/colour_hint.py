"""Does colour tell where to measure? The table of ``app/docs/colour.md``: run me on sources with registered colour.

A pixel's worth by the default score is weighed by how strong the edge of colour is there, against the
strongest within a seed's pitch around it: where two seeds lie on two sides of a step, and the step
shows in colour, the edge says where between them it runs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.selectors.acquire import SurfaceSelector, acquire
from selective_depth.selectors.acquire.surface import SurfacePlan
from selective_depth.selectors.choice import choose
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid

STRENGTHS = (0.3, 0.5, 0.7)
BUDGETS = (0.01, 0.02, 0.05)


def hint_of(colour: npt.NDArray[np.uint8], strength: float, pitch: int = 7) -> npt.NDArray[np.float32]:
    """Weight of every pixel, from 1 - strength where the colour's edge is elsewhere to 1 on it."""
    smooth = cv2.GaussianBlur(colour.astype(np.float32), (0, 0), 1.0)
    slopes = [cv2.Scharr(smooth, cv2.CV_32F, *way) / 32 for way in ((1, 0), (0, 1))]
    edge = np.sqrt(sum((slope**2).sum(axis=2) for slope in slopes))
    strongest = cv2.dilate(edge, np.ones((pitch, pitch), np.uint8))
    sure = strength * strongest / (strongest + 6)
    return np.asarray(1 - sure + sure * edge / (strongest + 2), np.float32)


@dataclass(frozen=True)
class ColourSelector(SurfaceSelector):
    """The default score, weighed by a hint."""

    hint: npt.NDArray[np.float32] | None = None

    def plan(self, samples: Samples) -> SurfacePlan:
        return ColourPlan(self, samples)


class ColourPlan(SurfacePlan):
    """An acquisition that looks at colour too."""

    def best(self, shots: int) -> npt.NDArray[np.int32]:
        self.look()
        rule = self._rule
        assert isinstance(rule, ColourSelector) and rule.hint is not None
        return choose(self.score * rule.hint, shots)


def ratios(frames: Sequence[DepthFrame], budget: float, rounds: int, strength: float) -> list[float]:
    """RMSE with the hint over that without, frame by frame."""
    found = []
    for frame in frames:
        assert frame.colour is not None and frame.registered
        seeds = SeedGrid.from_frame(frame)
        selectors = (ColourSelector(hint=hint_of(frame.colour, strength)), None)
        with_, without = (
            errors_of(acquire(frame.measure, seeds, budget, rounds, s).reconstruct(), frame.depth_mm).rmse_mm
            for s in selectors
        )
        found.append(with_ / without)
    return found


def main(uris: Sequence[str]) -> None:
    """Print the table."""
    print(f"| source | rounds | strength | {' | '.join(f'+{budget:.0%}' for budget in BUDGETS)} |")
    for uri in uris:
        with open_source(uri) as source:
            every = max((source.frame_count or 1) // 6, 1)
            frames = [frame for frame in source if frame.index % every == 0]
        for rounds in (2, 8):
            for strength in STRENGTHS:
                means = [np.exp(np.mean(np.log(ratios(frames, budget, rounds, strength)))) for budget in BUDGETS]
                print(f"| {uri} | {rounds} | {strength} | {' | '.join(f'{mean:.3f}' for mean in means)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
