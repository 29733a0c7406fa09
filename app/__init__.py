"""The command, the loop, the viewer and the reports."""

import os
from typing import TYPE_CHECKING

# Milliseconds after which the allocator in rerun-sdk, mimalloc, gives back what is free; it reads
# this when it is loaded. By its own default of 1,000, what is logged at 30 frames/s always finds
# room in memory that is free but not given back, and the process grows for thousands of frames.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "10")

if TYPE_CHECKING:
    __version__: str


def __getattr__(name: str) -> str:
    """The version, read when it is asked for: that takes longer than all the rest here."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("selective-depth")
