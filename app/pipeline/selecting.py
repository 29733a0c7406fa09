"""Which selector drives the shots: by name, or the user's own, from a file."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from selective_depth.app.console.errors import UsageError
from selective_depth.app.settings import Settings
from selective_depth.selectors.acquire import StepSelector, SurfaceSelector, best_selector
from selective_depth.selectors.even import EvenSelector
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import LongEdgeSelector, NeuralGasSelector
from selective_depth.selectors.selection import Selector, Worth

SELECTOR_NAMES = ("auto", "surface", "step", "improvement", "neural-gas", "neural-gas-edges", "even")
"""What ``--by`` takes, besides FILE.py:NAME."""


def gas_of(settings: Settings, threads: int | None) -> NeuralGasSelector:
    """The neural gas that the options describe."""
    options = asdict(settings.gas)
    del options["training"]  # of the frames after the first, which the pipeline sees to
    return NeuralGasSelector(**options, threads=threads)


def improvement_of(settings: Settings, threads: int | None) -> ImprovementSelector:
    """The improvement map that the options describe."""
    options = settings.improvement
    return ImprovementSelector(
        share=options.share, exponent=options.exponent, threads=threads, by_sums=options.formula == "eq27"
    )


def selector_of(settings: Settings, threads: int | None) -> Selector | Worth:
    """The selector that ``--by`` names.

    Parameters
    ----------
    settings : Settings
        Options of a run; `acquire.by` is one of `SELECTOR_NAMES`, or ``FILE.py:NAME``, a selector or a
        function from samples to a worth for every pixel.
    threads : int or None
        Kernel threads.

    Raises
    ------
    UsageError
        If there is no such selector.
    """
    by = settings.acquire.by
    makers: dict[str, Callable[[], Selector]] = {
        "auto": lambda: best_selector(settings.acquire.rounds, threads),
        "surface": lambda: SurfaceSelector(threads=threads),
        "step": lambda: StepSelector(threads=threads),
        "improvement": lambda: improvement_of(settings, threads),
        "neural-gas": lambda: gas_of(settings, threads),
        "neural-gas-edges": lambda: LongEdgeSelector(gas_of(settings, threads)),
        "even": EvenSelector,
    }
    return makers[by]() if by in makers else _users_own(by)


def _users_own(by: str) -> Selector | Worth:
    """A selector out of a Python file, which is run for it."""
    file, colon, name = by.rpartition(":")
    path = Path(file)
    if not colon or path.suffix != ".py":
        raise UsageError(
            f"--by is '{by}'; it must be one of {', '.join(SELECTOR_NAMES)}, or FILE.py:NAME, a selector of your own."
        )
    if not path.is_file():
        raise UsageError(f"--by is '{by}', but there is no file '{file}'; check its name.")
    try:
        found = runpy.run_path(file).get(name)
    except Exception as error:
        raise UsageError(f"--by is '{by}', but '{file}' fails: {type(error).__name__}: {error}.") from error
    if isinstance(found, type):  # a class: its instances are the selectors
        found = found()
    if not (callable(found) or isinstance(found, Selector)):
        raise UsageError(
            f"--by is '{by}', but '{file}' has no function or selector '{name}'; define"
            f" {name}(samples), which returns a worth for every pixel."
        )
    return found
