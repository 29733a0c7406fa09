"""Two threads for compiled kernels that release the GIL.

Numba's own `prange` is avoided: its default threading layer aborts the process when two
Python threads enter it at once, and here both selectors and the viewer run side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise

import numpy as np

from selective_depth.selectors.arrays import Floats


def default_threads() -> int:
    """Number of kernel threads: the processors this process may use, or SELECTIVE_DEPTH_THREADS."""
    asked = os.environ.get("SELECTIVE_DEPTH_THREADS", "")
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        return os.cpu_count() or 1


@cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    # Keyed by process: threads do not survive a fork.
    return ThreadPoolExecutor(max_workers=max(default_threads(), 1), thread_name_prefix="kernel")


def in_bands(
    kernel: Callable[..., object], rows: int, threads: int | None, *arguments: object, cost: Floats | None = None
) -> None:
    """Call ``kernel(first_row, end_row, *arguments)`` over bands of rows, in parallel; wait for all.

    Parameters
    ----------
    kernel : callable
        Must release the GIL and write only to its own rows.
    rows : int
        Number of rows in all.
    threads : int or None
        How many bands; None is `default_threads()`. 1 runs in the calling thread.
    *arguments
        What else the kernel takes.
    cost : float array of shape (rows,), optional
        How long each row takes beside the others, so that the bands take alike; default all alike.
    """
    count = max(min(threads or default_threads(), rows), 1)
    shares = np.arange(1, count) / count
    inner = shares * rows if cost is None else np.searchsorted(np.cumsum(cost) - cost / 2, shares * cost.sum())
    edges = 0, *inner.astype(int).tolist(), rows
    at_once(*(partial(kernel, *band, *arguments) for band in pairwise(edges)), threads=count)


def at_once(*calls: Callable[[], object], threads: int | None = None) -> None:
    """Call functions in parallel, or one after the other if `threads` is 1; wait for all."""
    if len(calls) == 1 or (threads or default_threads()) == 1:
        for call in calls:
            call()
        return
    pool = _pool(os.getpid())
    waiting = [pool.submit(call) for call in calls[1:]]
    try:
        calls[0]()
    finally:
        # Even if the first fails, no other may still be writing when we return.
        for future in waiting:
            future.result()
