"""The first run ever compiles its kernels: half of them here, in a process beside it.

Numba compiles one function at a time in a process, whatever the number of threads. What this
process compiles lands in the cache that the other one reads.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.kernels import kept_share
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.seeds import SeedGrid

PATIENCE_S = 2.0
"""Kernels that are in the cache are ready sooner than this."""
MOST_KEPT = 0.25
"""Where less of the kernels is in the cache this is the first run, and help is needed at once."""


@contextmanager
def compiling_beside() -> Iterator[None]:
    """Compile neural gas and acquisition beside what happens inside, if that takes its time."""
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command = [sys.executable, "-m", "selective_depth.app.pipeline.warm_up"]
        quiet = subprocess.DEVNULL
        started.append(subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet))

    timer = threading.Timer(PATIENCE_S if kept_share() > MOST_KEPT else 0.0, start)
    timer.daemon = True
    timer.start()
    try:
        with _garbage_kept():
            yield
        # Whatever became of it: what is not in the cache is compiled where it is needed.
        for process in started:
            process.wait()
    finally:
        timer.cancel()
        timer.join()  # it may be starting the process at this very moment
        for process in started:
            process.kill()
            process.wait()


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """Look for no garbage: a compiler's many small objects are all in use, and looking takes a seventh of its time."""
    looked = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if looked:
            gc.enable()


def main() -> None:
    """Run the kernels of neural gas, acquisition and reconstruction on a small frame."""
    depth_mm = np.full((96, 128), 2000, np.uint16)
    depth_mm[30:60, 40:90] = 1200
    depth_mm[:10, :10] = 0
    frame = DepthFrame(depth_mm, 0, 0, Camera.kinect(128, 96))
    seeds = SeedGrid.from_frame(frame, (24, 32))
    gas = NeuralGasSelector(nodes=100)
    with _garbage_kept():
        for _ in range(2):
            gas.update(seeds)
        acquire(frame.measure, seeds, 0.05, rounds=2).reconstruct()


if __name__ == "__main__":
    main()
