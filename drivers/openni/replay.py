"""Replay of an `.oni` recording through OpenNI2: every frame, exactly once."""

from __future__ import annotations

from pathlib import Path

from selective_depth.drivers.errors import (
    DamagedRecordingError,
    SourceEndedError,
    SourceError,
    SourceTimeoutError,
)
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni import inspect_oni
from selective_depth.drivers.openni.process import Message, Worker, camera_of, error_of
from selective_depth.drivers.source import DepthSource

_OPEN_S = 10.0  # opening takes milliseconds; beyond this it hangs
_SILENT_S = 8.0  # the worker itself gives up on a silent file after 5 s


class OpenNIRecording(DepthSource):
    """An `.oni` file, replayed frame by frame, however slow the reader.

    Depth, number and the differences of the timestamps are those of the recording; the camera
    comes from the recorded stream's field of view.

    Parameters
    ----------
    path : str or Path
        The recording; any path that the system can open.

    Raises
    ------
    SourceNotFoundError
        If there is no such file, or it may not be read.
    DamagedRecordingError
        If it is no recording, or damaged.
    RuntimeMissingError
        If OpenNI2 is not installed.
    """

    live = False
    dropped = 0

    def __init__(self, path: str | Path) -> None:
        self.uri = str(path)
        readable, self._flaw = _readable_frames(self.uri)
        self._worker: Worker | None = Worker("recording", path=self.uri, readable=readable)
        self._read_count = 0
        self._unheard_s = 0.0
        self._end: tuple[type[SourceError], str] = (
            SourceEndedError,
            f"'{self.uri}' has been closed.",
        )
        try:
            about = self._receive(_OPEN_S)
            if about is None:
                raise DamagedRecordingError(f"'{self.uri}' cannot be opened: OpenNI2 hangs on it.")
            self.camera = camera_of(about)
        except BaseException:
            self.close()
            raise
        self.fps = float(about["fps"])
        self.frame_count = int(about["frames"])

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame of the recording.

        Parameters
        ----------
        timeout_s : float, default 5.0
            How long to wait for it at most.

        Raises
        ------
        SourceEndedError
            After the last frame, and ever after.
        DamagedRecordingError
            If the recording cannot be read beyond this point; frames already delivered are good.
        SourceTimeoutError
            If the frame did not come in time; the next call goes on waiting for it.
        """
        if self._worker is None:
            kind, words = self._end
            raise kind(words)
        message = self._receive(timeout_s)
        if message is None:
            self._unheard_s += timeout_s
            if self._unheard_s < _SILENT_S:
                raise SourceTimeoutError(
                    f"'{self.uri}' gave no frame {self._read_count + 1} within {timeout_s:g} s."
                )
            raise self._over(DamagedRecordingError, f"{self._so_far()}: OpenNI2 hangs on it.")
        self._unheard_s = 0.0
        if message["kind"] == "end" and self._flaw:
            raise self._over(DamagedRecordingError, f"{self._so_far()}: {self._flaw}")
        if message["kind"] == "end":
            raise self._over(
                SourceEndedError, f"'{self.uri}' has ended after {self._read_count} frames."
            )
        frame = DepthFrame(
            depth_mm=self._worker.take(message, self.camera.width, self.camera.height),
            index=message["index"],
            timestamp_us=message["timestamp_us"],
            camera=self.camera,
            source=self.uri,
        )
        self._read_count += 1
        return frame

    def close(self) -> None:
        """Release the recording. Harmless when called twice."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _receive(self, timeout_s: float) -> Message | None:
        assert self._worker is not None
        message = self._worker.receive(timeout_s)
        if message is not None and message["kind"] == "error":
            error = error_of(message)
            raise self._over(type(error), str(error))
        if message is not None and message["kind"] == "died":
            raise self._over(
                DamagedRecordingError,
                f"{self._so_far()}: {message['reason']}. `selective-depth check` says what can be"
                " saved.",
            )
        return message

    def _so_far(self) -> str:
        return f"'{self.uri}' cannot be read beyond frame {self._read_count}"

    def _over(self, kind: type[SourceError], words: str) -> SourceError:
        """End it for good. The error is made anew for each reader: one that is kept would keep
        its traceback, and with it the last frame.
        """
        self._end = kind, words
        self.close()
        return kind(words)


def _readable_frames(path: str) -> tuple[int, str]:
    """How many frames a recording has, and what is harmlessly wrong with it.

    What OpenNI2 would answer with a crash is refused.
    """
    report = inspect_oni(path)
    advice = f"`selective-depth check '{path}'` says more; with --repair it saves what it can."
    if not report.openable:
        wrong = [problem for problem in report.problems if not problem.harmless]
        what = f"{wrong[0]}" if wrong else "it holds no depth frame"
        raise DamagedRecordingError(f"'{path}' is no whole recording: {what.rstrip('.')}. {advice}")
    flaw = f"{report.problems[0]}".rstrip(".") + f". {advice}" if report.problems else ""
    return report.readable_frames, flaw
