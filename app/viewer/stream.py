"""A recording stream and the one place that it goes to; the SDK's ways of blocking end here."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path
from typing import Self

import rerun as rr

from selective_depth.app.console.output import cannot_write
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.blueprint import Shown, blueprint
from selective_depth.app.viewer.logger import ResultLogger
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.neural_gas import RegionSelection

APPLICATION = "selective-depth"
WRITE_S = 3.0
"""A file that should have grown and has not for this long has failed."""
SMALL_BYTES = 256 << 10
"""Less than an image of 640x480: an image makes a chunk, while small things are gathered."""


class Recording:
    """A recording stream with one sink; whoever made it is the only thread to use it.

    Each sink has a stream of its own: what happens to one must not affect another.

    Parameters
    ----------
    target : rr.FileSink, rr.GrpcSink or rr.GrpcServerSink
        Where it goes; for a file use `to_file`. A viewer must be listening, or this blocks for 5 s.
    application : str
        Application id: recordings of the same one share their layout in a viewer.
    options : ViewerOptions
        What the user asked to see.
    batching : rr.ChunkBatcherConfig, optional
        How rows are put together before they are sent; by default at once, for a viewer.

    Attributes
    ----------
    logger : ResultLogger
        What logs into it.
    """

    def __init__(
        self,
        target: rr.FileSink | rr.GrpcSink | rr.GrpcServerSink,
        application: str,
        options: ViewerOptions,
        batching: rr.ChunkBatcherConfig | None = None,
    ) -> None:
        # RERUN=off, which others set for their own programs, would make every call do nothing
        # without an error; whoever names a place to see a run at wants to see it.
        os.environ.pop("RERUN", None)
        self._stream = rr.RecordingStream(application, batcher_config=batching)
        self._stream.set_sinks(target)
        # The SDK imports half of what it needs at first use, which takes it up to a second:
        # that is now, and not while the first frames come.
        blueprint(Shown(by="it", detail=True))
        self.logger = ResultLogger(self._stream, options)

    @classmethod
    def to_file(cls, path: Path, application: str, options: ViewerOptions, *, index: bool) -> Self:
        """Write an .rrd, with an index at its end or without.

        The index makes files quicker to open, but the SDK gathers it in memory, chunk by chunk:
        some 60 MB for 1,000 frames where every image is a chunk, 3 MB with up to 1 MiB in each.
        Without one, it is the images waiting for such a chunk to fill that cost memory, 50 MB
        instead of 17: then each goes by itself. Neither makes saving faster or slower.
        """
        batching = rr.ChunkBatcherConfig(
            flush_tick=timedelta(seconds=1), flush_num_bytes=1 << 20 if index else SMALL_BYTES
        )
        return cls(rr.FileSink(str(path), write_footer=index), application, options, batching)

    def flush(self, timeout_s: float = 1e9) -> bool:
        """Wait until everything is sent or written; False if that fails or takes too long."""
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError:
            return False
        return True

    def is_written(self, path: Path, patience_s: float = WRITE_S) -> bool:
        """Wait until everything is in its file; False if the file should grow and does not.

        The SDK's writer says nothing when a write fails, and never ends after it.
        """
        size = path.stat().st_size
        while not self.flush(patience_s):
            before, size = size, path.stat().st_size
            if size == before:
                return False
        return True

    def finish(self) -> None:
        """End it, with its index. Only after a successful `flush`; otherwise it waits for ever."""
        self._stream.disconnect()

    def abandon(self) -> None:
        """Give up on a sink that died.

        The SDK waits for ever for such a sink when its stream is destroyed, so it never is.
        """
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._stream))


def never_wait_at_exit() -> None:
    """Keep the SDK from waiting, when the program ends, for sinks that have died."""
    rr.unregister_shutdown()


def save_trainings(path: Path, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]) -> None:
    """Write an .rrd of one frame's regions after trainings of several lengths.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    try:
        path.write_bytes(b"")
    except OSError as error:
        raise cannot_write(path, error) from None
    never_wait_at_exit()
    recording = Recording.to_file(path, f"{APPLICATION} epochs", ViewerOptions(detail=True), index=True)
    recording.logger.log_trainings(frame, trainings)
    if not recording.is_written(path):
        recording.abandon()
        if path.is_file():
            path.unlink()
        raise OutputError(f"writing '{path}' failed. Check the disk and its quota, and run it again.")
    recording.finish()
