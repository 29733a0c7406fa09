"""A recording played as a sensor would deliver it: on time, the newest frame first."""

from __future__ import annotations

import threading
import time

from selective_depth.drivers.errors import SourceEndedError, SourceTimeoutError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import DepthSource, RelayedSource


class RealtimeSource(RelayedSource):
    """Paces another source by its timestamps; frames not read in time are lost and counted.

    The clock starts when the second frame is asked for: with the first, a reader gets ready.

    Parameters
    ----------
    source : DepthSource
        A recording. It is owned from here on and closed with this one.
    speed : float, default 1
        How many times as fast as it was recorded.
    """

    live = True

    def __init__(self, source: DepthSource, speed: float = 1.0) -> None:
        self._source = source
        self._speed = speed
        self.uri = source.uri
        self.camera = source.camera
        self.fps = source.fps * speed
        self.frame_count = source.frame_count
        self.state = source.state
        self._changed = threading.Condition()
        self._newest: DepthFrame | None = None
        self._end: Exception | None = None
        self._closing = threading.Event()
        self._first_taken = False
        self._asked_again = threading.Event()
        self._thread = threading.Thread(target=self._play, name="realtime", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the newest frame that has not been read; see `DepthSource.read`."""
        self.check_process()
        if self._first_taken:
            self._asked_again.set()
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self._end, timeout_s)
            if self._newest is not None:
                frame, self._newest = self._newest, None
                self._first_taken = True
                return frame
            if self._end is not None:
                raise self._end
        raise SourceTimeoutError(f"no frame of '{self.uri}' within {timeout_s:.1f} s; its disk may be slow or absent")

    def close(self) -> None:
        """Stop playing and close the recording."""
        self._closing.set()
        self._asked_again.set()
        self._thread.join()
        self._source.close()

    def _play(self) -> None:
        try:
            first = self._source.read()
            self._hand_over(first)
            self._asked_again.wait()
            start_s = time.perf_counter()
            while not self._closing.is_set():
                frame = self._source.read()
                due_s = start_s + (frame.timestamp_us - first.timestamp_us) / (1e6 * self._speed)
                if self._closing.wait(max(0.0, due_s - time.perf_counter())):
                    return
                self._hand_over(frame)
        except Exception as error:  # noqa: BLE001 - a reader must hear of it, whatever it is
            if isinstance(error, SourceEndedError):
                # The last frame is on show for as long as every other one.
                self._closing.wait(1 / self.fps)
            with self._changed:
                self._end = error
                self._changed.notify_all()

    def _hand_over(self, frame: DepthFrame) -> None:
        if (tap := self.tap) is not None:
            tap(frame)
        with self._changed:
            if self._newest is not None:
                self.dropped += 1
            self._newest = frame
            self._changed.notify_all()
