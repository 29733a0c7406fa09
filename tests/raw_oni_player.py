"""Plays .oni files through OpenNI2 with no check at all, each in a process of its own.

What the fuzz tests measure against: whatever OpenNI2 itself makes of a file, a crash or a hang
included. A script, so that its children are forked before any thread or native library is there:
it reads one file name a line and answers with one JSON line each.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

HANG_S = 10.0
SETTLE_S = 0.1
MOST_FRAMES = 200


@dataclass(frozen=True)
class Outcome:
    """What became of playing a file.

    Parameters
    ----------
    ended : str
        ``frames``, ``error``, ``crash`` or ``hang``.
    frames : int
        Frames delivered, if it ended with ``frames``.
    digest : str
        Of their sizes, numbers and pixels.
    detail : str
        The error or the signal.
    """

    ended: str
    frames: int = 0
    digest: str = ""
    detail: str = ""

    @property
    def unharmed(self) -> bool:
        """True if the process lived."""
        return self.ended in ("frames", "error")


def play_all(paths: Iterable[Path], library: Path, patience_s: float = 0.4) -> Iterator[Outcome]:
    """Play files one after the other; an outcome each.

    `patience_s` is how long a frame is waited for; on a busy machine the short default may be too
    short.
    """
    with subprocess.Popen(
        [sys.executable, __file__, str(library), str(patience_s)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as player:
        assert player.stdin is not None and player.stdout is not None
        for path in paths:
            print(path, file=player.stdin, flush=True)
            yield Outcome(**json.loads(player.stdout.readline()))
        player.stdin.close()


def digest_of(frames: Iterable[tuple[int, int, int, bytes]]) -> tuple[int, str]:
    """Number and digest of frames given as number, height, width and pixels."""
    digest, count = hashlib.blake2b(digest_size=16), 0
    for number, height, width, pixels in frames:
        digest.update(f"{number} {height} {width}".encode())
        digest.update(pixels)
        count += 1
    return count, digest.hexdigest()


def _play(path: str, library: str, patience_s: float) -> dict[str, object]:
    from primesense import openni2
    from primesense.utils import OpenNIError

    folder, openni2._dll_name = os.path.split(library)
    openni2.initialize(folder)
    descriptor = os.open(path, os.O_RDONLY)
    try:
        device = openni2.Device.open_file(f"/proc/self/fd/{descriptor}".encode())
        stream = device.create_depth_stream()
        device.playback.set_speed(-1.0)
        announced = device.playback.get_number_of_frames(stream)
        stream.start()
    except OpenNIError as error:
        return {"ended": "error", "detail": str(error)[:80]}

    def frames() -> Iterator[tuple[int, int, int, bytes]]:
        last = 0
        wanted = announced if 0 < announced <= MOST_FRAMES else MOST_FRAMES
        while last < wanted and openni2.wait_for_any_stream([stream], patience_s) is not None:
            frame = stream.read_frame()
            number = frame.frameIndex
            if number <= last:  # it plays round and round
                frame.close()
                return
            last = number
            yield number, frame.height, frame.width, bytes(frame.get_buffer_as_uint8())
            frame.close()

    count, digest = digest_of(frames())
    stream.stop()
    time.sleep(SETTLE_S)
    stream.close()
    time.sleep(SETTLE_S)
    device.close()
    return {"ended": "frames", "frames": count, "digest": digest}


def _play_in_child(path: str, library: str, patience_s: float) -> dict[str, object]:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.write(writing, json.dumps(_play(path, library, patience_s)).encode())
        os._exit(0)
    os.close(writing)
    end = time.monotonic() + HANG_S
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            os.close(reading)
            return {"ended": "hang"}
        time.sleep(0.002)
    with os.fdopen(reading) as answer:
        text = answer.read()
    if os.WIFSIGNALED(status):
        return {"ended": "crash", "detail": signal.Signals(os.WTERMSIG(status)).name}
    if not text:
        return {"ended": "crash", "detail": f"exit code {os.WEXITSTATUS(status)}"}
    answered: dict[str, object] = json.loads(text)
    return answered


def _serve(library: str, patience_s: float) -> None:
    from primesense import openni2  # noqa: F401 - imported once, for all children

    for line in sys.stdin:
        print(json.dumps(_play_in_child(line.rstrip("\n"), library, patience_s)), flush=True)


if __name__ == "__main__":
    _serve(sys.argv[1], float(sys.argv[2]))
