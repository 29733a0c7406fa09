"""`python tests/virtual_sensor OUT.oni FRAMES.npy`: record an array through the real OpenNI2."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from virtual_sensor import record_oni

if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python tests/virtual_sensor OUT.oni FRAMES.npy")
    record_oni(np.load(sys.argv[2]), Path(sys.argv[1]))
