"""The picture and the table of `app/docs/virtual-kinect.md`: python tests/make_virtual_docs.py.

The table needs the real frames in `../shared/data`; without them it has the virtual rows only.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from kinect_residuals import plane_residuals
from matplotlib.figure import Figure

from selective_depth.app.pictures import Panel, sheet, write_picture
from selective_depth.app.pictures.panels import depth_panel
from selective_depth.drivers.open import open_source
from selective_depth.drivers.virtual.scenes import SCENES

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "app" / "docs" / "pictures" / "virtual-kinect.png"


def panel(uri: str, caption: str) -> Panel:
    with open_source(uri) as source:
        return depth_panel(source.read(), caption)


def picture() -> Figure:
    rows = []
    for noise, told in (("off", "exact"), ("kinect", "as sensed")):
        uris = {scene: f"virtual:{scene}?seed=7&noise={noise}" for scene in SCENES}
        rows.append(("", [panel(uri, f"{scene}, {told}") for scene, uri in uris.items()]))
    return sheet(rows, legend=False)


def row(name: str, frames: list[npt.NDArray[np.uint16]]) -> str:
    rest = np.concatenate([plane_residuals(frame) for frame in frames])
    sizes = rest.std(axis=(1, 2))
    alike = [(rest[:, :, :-k] * rest[:, :, k:]).mean() / rest.var() for k in (1, 2, 3)]
    holes = [cv2.connectedComponents((frame == 0).astype(np.uint8))[0] - 1 for frame in frames]
    share = np.mean([(frame == 0).mean() for frame in frames])
    return (
        f"| {name} | {np.median(sizes):.2f} ({np.quantile(sizes, 0.1):.2f} to"
        f" {np.quantile(sizes, 0.9):.2f}) | {alike[0]:.2f}, {alike[1]:.2f}, {alike[2]:.2f} |"
        f" {np.median(holes):.0f} | {share:.1%} |"
    )


def main() -> None:
    write_picture(PICTURE, picture(), dpi=60)
    print("| frames | error, steps | likeness 1, 2, 3 px apart | holes a frame | pixels lost |")
    print("|---|---|---|---|---|")
    real = sorted((ROOT.parent / "shared" / "data" / "sequence").glob("*.png"))[::10]
    if real:
        print(row("Kinect, an office", [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in real]))
    for scene in SCENES:
        with open_source(f"virtual:{scene}?frames=120") as source:
            frames = [frame.depth_mm for frame in source if frame.index % 10 == 0]
        print(row(f"`virtual:{scene}`", frames))


if __name__ == "__main__":
    main()
