"""What a run leaves out where the machine is too slow for all of it, in a stated order."""

from __future__ import annotations

from dataclasses import dataclass

from selective_depth.app.settings import MOST_ROUNDS, AcquireOptions

WINDOW = 30
"""Frames over which it is judged: a second of a sensor's."""
TOO_MANY_SKIPPED = 2
"""Frames of a window that may not be missed; one may be anybody's."""
SPARE = 0.2
"""Share of the time that a run has to spend waiting for frames before it takes something back."""
PATIENCE = (2, 64)
"""Quiet windows before something is taken back: at first, and after that has failed again and again."""


@dataclass(frozen=True)
class Eased:
    """How much is made of a frame.

    Attributes
    ----------
    model_every, gas_every : int
        The model, with the even lattice's, and the neural gas in one frame of so many.
    rounds : int
        Rounds of an acquisition at most.
    said : str
        What is left out, in words; empty if it is nothing.
    """

    model_every: int = 1
    rounds: int = MOST_ROUNDS
    gas_every: int = 1
    said: str = ""


ALL = Eased()
"""Everything that was asked for."""


def levels(options: AcquireOptions) -> tuple[Eased, ...]:
    """What is made at each level: everything, then no model of every second frame, fewer rounds, gas in every second.

    A memory makes its model on the way and spends its rounds as it must: there only the gas is left.
    """
    without: list[Eased] = [ALL]
    if options.budget and options.memory == "off":
        without.append(Eased(2, said="model every 2nd frame"))
        fewer = max(options.rounds // 2, 2)
        if fewer < options.rounds:
            without.append(Eased(2, fewer, said=f"{without[-1].said}, {fewer} rounds instead of {options.rounds}"))
    last = without[-1]
    said = f"{last.said}, neural gas every 2nd frame".lstrip(", ")
    return (*without, Eased(last.model_every, last.rounds, 2, said))


class Governor:
    """Watches how a live run keeps up, and says what to leave out.

    It gives up one thing when frames are skipped, and takes it back when there is time to spare;
    each time that this was too early it waits twice as long with the next try.

    Parameters
    ----------
    options : AcquireOptions
        What was asked for.
    period_ms : float or None
        Time from frame to frame; None where frames wait until they are made, and nothing is to be left out.

    Attributes
    ----------
    eased : Eased
        What is made now.
    most : Eased
        The most that was given up so far.
    frames : int
        In how many frames something was left out.
    """

    def __init__(self, options: AcquireOptions, period_ms: float | None) -> None:
        self._period_ms = period_ms
        self._patience = PATIENCE[0]
        self.frames, self.most = 0, ALL
        self.restart(options)

    def restart(self, options: AcquireOptions) -> None:
        """Begin anew with what is asked for now."""
        self._levels = (ALL,) if self._period_ms is None else levels(options)
        self._level = self._seen = self._skipped = self._quiet = 0
        self._waited_ms = 0.0
        self._tried = False

    @property
    def eased(self) -> Eased:
        """What is made now."""
        return self._levels[self._level]

    def note(self, skipped: int, waited_ms: float) -> bool:
        """Take in how a frame came; whether something changes.

        Parameters
        ----------
        skipped : int
            Frames skipped since the one before.
        waited_ms : float
            How long this one was waited for.
        """
        self.frames += self._level > 0
        self._seen, self._skipped = self._seen + 1, self._skipped + skipped
        self._waited_ms += waited_ms
        if self._skipped >= TOO_MANY_SKIPPED:
            return self._move(1)
        if self._seen < WINDOW:
            return False
        spare = self._period_ms is not None and self._waited_ms > SPARE * self._seen * self._period_ms
        self._quiet = self._quiet + 1 if spare else 0
        if self._tried and self._quiet >= self._patience:  # what was taken back last has lasted
            self._tried, self._patience = False, PATIENCE[0]
        self._begin_window()
        return self._level > 0 and self._quiet >= self._patience and self._move(-1)

    def _move(self, by: int) -> bool:
        if by > 0 and self._tried:
            self._patience = min(2 * self._patience, PATIENCE[1])
        self._tried = by < 0
        before, self._level = self._level, min(max(self._level + by, 0), len(self._levels) - 1)
        self._quiet = 0
        self._begin_window()
        self.most = max(self.most, self.eased, key=lambda each: len(each.said))
        return self._level != before

    def _begin_window(self) -> None:
        self._seen, self._skipped, self._waited_ms = 0, 0, 0.0
