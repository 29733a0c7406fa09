"""Make everything in `recordings/` again: `make recordings`."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.oni import write_oni
from selective_depth.drivers.open import open_source

RECORDINGS = Path(__file__).parent.parent / "recordings"
ORIGINAL = "virtual:workstation?frames=30&speed=2&seed=7"
OTHERS = {
    "ball": "virtual:ball?frames=8&speed=2&seed=7&colour=off",
    "firehose": "virtual:firehose?frames=8&speed=2&seed=7&colour=off",
}
LIMIT_MB = 12


def main() -> None:
    for name in OTHERS:
        shutil.rmtree(RECORDINGS / name, ignore_errors=True)
    recording = RECORDINGS / "workstation.oni"
    recording.unlink(missing_ok=True)
    with open_source(ORIGINAL) as source:
        originals = list(source)
    write_oni(recording, originals, fps=30)
    with open_source(recording) as source:
        for original, frame in zip(originals, source, strict=True):
            if not np.array_equal(original.depth_mm, frame.depth_mm) or frame.colour is None:
                sys.exit(f"{recording} does not hold the frames that were recorded")
    for name, uri in OTHERS.items():
        with open_source(uri) as source:
            write_folder(RECORDINGS / name, source, compression=9)
    total = sum(file.stat().st_size for file in RECORDINGS.rglob("*") if file.is_file()) / 1e6
    print(f"{RECORDINGS}: {total:.1f} MB of at most {LIMIT_MB}")
    if total > LIMIT_MB:
        sys.exit("too much: take fewer frames")


if __name__ == "__main__":
    main()
