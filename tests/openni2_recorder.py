"""Record a sensor with OpenNI2's own recorder: LIBRARY OUT FRAMES WIDTH HEIGHT.

The project records with a writer of its own; files of the real recorder are what it must read.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from primesense import openni2

from selective_depth.drivers.openni import worker

DATA_BEGIN = b"NIR\0\x08\0\0\0"  # the record after which it takes frames


class Parent:
    """Nobody to talk to."""

    def send(self, kind: str, **values: object) -> None: ...


def main(library: str, out: str, frames: int, width: int, height: int) -> None:
    worker.initialize({"library": library})
    settings = {"width": width, "height": height, "fps": 30, "registration": False, "nearest": False}
    settings["colouring"] = {"wanted": False}
    live = worker.LiveStream({"uri": "", "like": None, "settings": settings}, Parent())
    recorder = openni2.Recorder(out.encode())
    recorder.attach(live.stream, False)
    recorder.start()
    deadline = time.monotonic() + 5
    while not Path(out).exists() or DATA_BEGIN not in Path(out).read_bytes()[: 1 << 16]:
        assert time.monotonic() < deadline, "OpenNI2 does not begin the file"
        time.sleep(0.005)
    time.sleep(worker.SETTLE_S)
    live.start()
    seen = 0
    while seen < frames:
        stream = openni2.wait_for_any_stream(live.streams, worker.WAIT_S)
        if stream is not None:
            seen += 1
            stream.read_frame().close()
    live.stream.stop()
    recorder.stop()
    recorder.close()
    live.close()
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
