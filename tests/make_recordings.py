"""Make everything in `recordings/` again: `make recordings`.

The `.oni` goes through the real OpenNI2 recorder, fed by the virtual sensor of the tests; so
this needs the OpenNI2 runtime, its headers and a C++ compiler (`make system-packages`).
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
from virtual_sensor import record_oni

from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.open import open_source

RECORDINGS = Path(__file__).parent.parent / "recordings"
ORIGINAL = "virtual:workstation?frames=30&speed=2&seed=7"
OTHERS = {"ball": "virtual:ball?frames=8&speed=2&seed=7", "firehose": "virtual:firehose?frames=8&speed=2&seed=7"}
LIMIT_MB = 12


def main() -> None:
    for name in OTHERS:
        shutil.rmtree(RECORDINGS / name, ignore_errors=True)
    with open_source(ORIGINAL) as source:
        originals = np.stack([frame.depth_mm for frame in source])
    recording = RECORDINGS / "workstation.oni"
    record_oni(originals, recording)
    with open_source(recording) as source:
        frames = list(source)
    if not np.array_equal(originals, [frame.depth_mm for frame in frames]):
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
