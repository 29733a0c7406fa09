"""Handing results to something slow, which must never hold up the one who hands them over."""

from __future__ import annotations

import threading
import time
from collections import deque

from selective_depth.app.viewer.sinks import Item, Sink


class Handover:
    """A worker thread that feeds a sink from a short queue; it alone calls it.

    It waits for room, at most `patience_s`, for a sink that is merely slow, and not at all for one that
    has stalled: then the oldest item goes, counted in `dropped`. With infinite patience every item arrives.

    Parameters
    ----------
    sink : Sink
        Where items go.
    patience_s : float, default 0
        Longest wait for room, in seconds, before an item is dropped.
    capacity : int, default 2
        Items that may wait.

    Attributes
    ----------
    dropped : int
        Items that never reached the sink, or that it failed or stalled over.
    ready : threading.Event
        Set once the sink is open, or has failed to.
    failure : Exception or None
        What ended the sink before its time; nothing is taken any more.
    """

    def __init__(self, sink: Sink, *, patience_s: float = 0.0, capacity: int = 2) -> None:
        self.sink = sink
        self.dropped = 0
        self.failure: Exception | None = None
        self.ready = threading.Event()
        self._patience_s = patience_s
        self._capacity = capacity
        self._queue: deque[Item] = deque()
        self._in_hand = 0  # 1 while the sink takes an item
        self._changed = threading.Condition()
        self._finishing = False
        self._stalled = False
        self._thread = threading.Thread(target=self._serve, name=sink.name, daemon=True)
        self._thread.start()

    def offer(self, item: Item) -> None:
        """Hand over an item."""
        with self._changed:
            deadline_s = time.monotonic() + (0.0 if self._stalled else self._patience_s)
            while self._full() and (left_s := deadline_s - time.monotonic()) > 0:
                self._changed.wait(min(left_s, 0.2))  # in short turns: Ctrl-C must get through on every platform
            if self.failure is not None:
                self.dropped += 1
                return
            self._stalled = self._full()
            if self._stalled:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(item)
            self._changed.notify_all()

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until the sink has taken everything, or has failed; False if it has not in time."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self.failure) or not (self._queue or self._in_hand), timeout_s)

    def finish(self, timeout_s: float) -> bool:
        """Let the sink take what is waiting, and close it.

        Returns
        -------
        bool
            False if it did not end in time. It is then left behind in its thread, which
            does not keep the process alive.
        """
        with self._changed:
            self._finishing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        with self._changed:
            if self._thread.is_alive():
                self.dropped += len(self._queue) + self._in_hand
                return False
        return True

    def _full(self) -> bool:
        return self.failure is None and len(self._queue) >= self._capacity

    def _serve(self) -> None:
        try:
            self.sink.open()
            self.ready.set()
            while (item := self._next()) is not None:
                self.sink.put(item)
            self.sink.close()
        except Exception as error:  # noqa: BLE001 - whoever hands over must hear of it
            with self._changed:
                self.failure = error
                self.dropped += len(self._queue) + self._in_hand
                self._queue.clear()
                self._changed.notify_all()
            self.ready.set()

    def _next(self) -> Item | None:
        with self._changed:
            self._in_hand = 0
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._queue or self._finishing)
            self._stalled = False
            item = self._queue.popleft() if self._queue else None
            self._in_hand = int(item is not None)
            self._changed.notify_all()
            return item
