"""Is selecting worth it? Every strategy on the same frames, by the same protocol.

Each strategy spends the same budget from the same seeds; `reconstruct` makes the same kind of
model of what it measured, and the model is held against the full frame. RMSE is reported as its
ratio to an even lattice of as many measurements, and as the share of the way from that lattice
to an oracle that shoots at the largest true errors.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np

from selective_depth.app.archive import engine
from selective_depth.app.console import interrupt
from selective_depth.app.evaluation.strategies import STRATEGIES, Case, strategies_of, strategy_of
from selective_depth.app.pipeline import open_and_tell
from selective_depth.app.settings import ComparisonOptions, Settings
from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.selectors.acquire import shots_of
from selective_depth.selectors.parallel import default_threads
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.reconstruct import reconstruct

ENDLESS_FRAMES = 120
"""How many frames of a source without end are looked at."""

FULL_NAMES = {
    "geo": "ratio_geometric_mean",
    "worst": "ratio_worst",
    "share": "oracle_share_mean",
    "share_min": "oracle_share_least",
    "wrong": "wrong_share",
    "missed": "missed_share",
}
Results = dict[str, dict[str, dict[str, float]]]
"""Budget -> strategy -> figure, as the JSON file has it."""


@dataclass(frozen=True)
class Errors:
    """How far a model is from the frame it is of.

    Parameters
    ----------
    rmse_mm, mae_mm : float
        Root mean square and mean absolute error over the pixels with depth, millimetres.
    wrong : float
        Share of the pixels that are wrong (`ModelErrors`).
    shots : int
        Measurements spent beyond the seeds.
    missed : float
        Share of all measurements that returned nothing.
    """

    rmse_mm: float
    mae_mm: float
    wrong: float
    shots: int
    missed: float


@dataclass(frozen=True)
class Outcome:
    """What one strategy made of one frame, once per random seed.

    Parameters
    ----------
    frame : str
        Its source and its number.
    budget : float
        Measurements beyond the seeds, as a share of the frame's pixels.
    strategy : str
        Name of the strategy.
    errors : tuple of Errors
        One of each draw.
    source : str
        The frame's source.
    index : int
        Its number there.
    measured : float
        Share of the frame's pixels measured by those that spend the budget, seeds included.
    """

    frame: str
    budget: float
    strategy: str
    errors: tuple[Errors, ...]
    source: str = ""
    index: int = 0
    measured: float = 0.0


def run_strategy(name: str, case: Case) -> Errors:
    """Let a strategy spend its budget on one frame, and measure the errors of its model."""
    uv = strategy_of(name).pixels(case)
    depth_mm = case.frame.measure(uv)
    model_mm = reconstruct(uv, depth_mm, case.frame.shape)
    errors = errors_of(model_mm, case.frame.depth_mm)
    return Errors(*errors, len(uv) - len(case.seed_uv), float(np.mean(depth_mm == 0)))


_Work = Callable[[DepthFrame], list[Outcome]]


def _evaluate_frame(
    options: ComparisonOptions, names: Sequence[str], settings: Settings, frame: DepthFrame
) -> list[Outcome]:
    label = f"{frame.source} {frame.index}"
    outcomes = []
    for budget in options.budget:
        shots = shots_of(float(budget), frame.shape)
        measured = (shots + settings.seeds.rows * settings.seeds.columns) / frame.depth_mm.size
        # One for all strategies: what several of them build on is made once.
        cases = [Case(frame, settings, shots, options.rounds, seed) for seed in range(options.random_seeds)]
        for name in names:
            errors = tuple(run_strategy(name, case) for case in cases[: None if strategy_of(name).chance else 1])
            outcomes.append(Outcome(label, budget, name, errors, frame.source, frame.index, measured))
    return outcomes


def _begin_worker() -> None:
    # Frames are spread over processes; threads inside them would only fight for the cores.
    os.environ["SELECTIVE_DEPTH_THREADS"] = "1"
    # Ctrl-C goes to all processes of a terminal: the parent says what becomes of it, and a worker
    # ends with its parent, however that ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def frames_of(sources: Sequence[str], every: int, frames: int | None) -> Iterator[DepthFrame]:
    """Every n-th frame of each source that has any depth, up to a number of frames from each."""
    for uri in sources:
        with open_source(uri) as source:
            looked_at = islice(source, ENDLESS_FRAMES if source.frame_count is None else None)
            chosen = (frame for frame in looked_at if frame.index % every == 0 and frame.depth_mm.any())
            yield from islice(chosen, frames)


def outcomes(
    sources: Sequence[str],
    options: ComparisonOptions,
    settings: Settings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Outcome]:
    """Run the strategies on frames of some sources.

    Parameters
    ----------
    sources : sequence of str
        As `open_source` takes them.
    options : ComparisonOptions
        Which frames, budgets and strategies; "uniform" and "oracle" are always run. One job runs
        in this process; the scheduler is one as for `archive.engine`.
    settings : Settings
        Of the seeds, and of the two published selectors.
    progress : callable, optional
        Called with the frames done and the frames in all, as far as they are known.

    Raises
    ------
    UsageError
        If there is no such strategy.
    SourceNotFoundError
        If the sources hold no frame with depth.
    """
    wanted = {*strategies_of(options.strategies), "uniform", "oracle"}
    names = [n for n in STRATEGIES if n in wanted] + sorted(wanted.difference(STRATEGIES))
    jobs = options.jobs or default_threads()
    work: _Work = partial(_evaluate_frame, options, names, settings)
    total = _most(sources, options)
    found: dict[int, list[Outcome]] = {}
    progress(0, total)
    chosen = frames_of(sources, options.every, options.frames)
    with ExitStack() as stack:
        if options.scheduler is not None:
            client = stack.enter_context(engine(options.scheduler))
            workers = max(1, sum(client.nthreads().values()))
            made = _through(client.get_executor(pure=False), chosen, work, workers)
        elif min(jobs, total) == 1:
            made = enumerate(map(work, chosen))
        else:
            made = _through(stack.enter_context(_processes(jobs)), chosen, work, jobs)
        for number, of_frame in made:
            found[number] = of_frame
            progress(len(found), total)
    if not found:
        raise SourceNotFoundError(f"no frame with depth in {', '.join(sources)}; give another source or --every 1.")
    progress(len(found), len(found))
    return [outcome for number in sorted(found) for outcome in found[number]]


def _most(sources: Sequence[str], options: ComparisonOptions) -> int:
    """How many frames `frames_of` finds, if all of them have depth."""
    total = 0
    for uri in sources:
        with open_and_tell(uri) as source:
            count = ENDLESS_FRAMES if source.frame_count is None else source.frame_count
        total += min(-(-count // options.every), options.frames or count)
    return total


@contextmanager
def _processes(jobs: int) -> Iterator[Executor]:
    """A pool of processes on this machine, each with one kernel thread."""
    # Spawned, not forked: the parent may hold threads and locks of other libraries.
    spawn = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_begin_worker)
    try:
        yield pool
    except BaseException:  # Ctrl-C, say: what is under way is not waited for
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def _through(
    pool: Executor, chosen: Iterable[DepthFrame], work: _Work, workers: int
) -> Iterator[tuple[int, list[Outcome]]]:
    """Evaluate frames, with no more of them in memory than keep the workers busy; yields them as they are done."""
    under_way: dict[Future[list[Outcome]], int] = {}

    def settled() -> Iterator[tuple[int, list[Outcome]]]:
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            yield under_way.pop(future), future.result()

    for number, frame in enumerate(chosen):
        # A worker whose start is cut short reports that nobody told it what to do.
        with interrupt.deferred(), interrupt.started_deaf():
            under_way[pool.submit(work, frame)] = number
        if len(under_way) == 2 * workers:
            yield from settled()
    while under_way:
        yield from settled()


def summarise(found: Sequence[Outcome]) -> Results:
    """Figures per budget and strategy over all frames (and random seeds).

    ``geo`` and ``worst``: geometric mean and greatest of the RMSE ratio to `uniform`; ``share``
    and ``share_min``: mean and least of the oracle share, the way covered from `uniform` to
    `oracle`; ``wrong``, ``missed``: mean shares. Each of these has its full name as well
    (`FULL_NAMES`). ``rmse_mm``, ``mae_mm``: means.
    """
    results: Results = {}
    peers = {(o.frame, o.budget, o.strategy): o.errors[0].rmse_mm for o in found}
    for budget, name in dict.fromkeys((o.budget, o.strategy) for o in found):
        of_each = [(o.frame, error) for o in found if (o.budget, o.strategy) == (budget, name) for error in o.errors]
        held = [(e.rmse_mm, peers[frame, budget, "uniform"], peers[frame, budget, "oracle"]) for frame, e in of_each]
        ratios = [rmse / uniform for rmse, uniform, _ in held if uniform > 0]
        shares = [(uniform - rmse) / (uniform - oracle) for rmse, uniform, oracle in held if uniform > oracle]
        figures = {
            "geo": float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-9))))) if ratios else 1.0,
            "worst": max(ratios, default=1.0),
            "share": float(np.mean(shares)) if shares else 0.0,
            "share_min": min(shares, default=0.0),
        }
        for figure in ("rmse_mm", "mae_mm", "wrong", "missed"):
            figures[figure] = float(np.mean([getattr(error, figure) for _, error in of_each]))
        figures |= {full: figures[short] for short, full in FULL_NAMES.items()}
        results.setdefault(f"{budget:.2f}" if round(budget, 2) == budget else f"{budget:g}", {})[name] = figures
    return results
