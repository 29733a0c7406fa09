"""The parent's side of the process that owns OpenNI2."""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from selective_depth.drivers.colour import rgb_of
from selective_depth.drivers.errors import SourceError
from selective_depth.drivers.frame import Camera, ColourArray, DepthArray
from selective_depth.drivers.openni.runtime import find_runtime
from selective_depth.drivers.openni.usb import usb_advice

Message = dict[str, Any]
"""What the worker says; its ``kind`` tells what else is in it."""

_SLOTS = 20  # a third of a second of depth and colour, for one that records on a busy machine
_SLOT_BYTES = 1920 * 1080 * 2  # more than any sensor of this kind has; unused pages cost none
_ERRORS = {kind.__name__: kind for kind in SourceError.__subclasses__()}


def error_of(message: Message) -> SourceError:
    """The named error that an ``error`` message stands for."""
    text = str(message["message"])
    if message["remedy"]:
        text += " " + (usb_advice(find_runtime().drivers) or message["remedy"])
    return _ERRORS[message["error"]](text)


def camera_of(stream: Message, given: tuple[float, ...] | None = None) -> tuple[Camera, tuple[str, ...]]:
    """Intrinsics of a stream from its fields of view, and what is doubtful about them."""
    size = int(stream["width"]), int(stream["height"])
    if given is not None:
        return Camera(*size, *given), ()
    angles = float(stream["fov_x_rad"]), float(stream["fov_y_rad"])
    advice = "; give --camera fx,fy,cx,cy if you know them"
    if all(math.pi < angle < 180 for angle in angles):
        camera = Camera.from_fov(*size, *map(math.radians, angles))
        return camera, (f"its driver states its field of view in degrees and is read as such{advice}",)
    if not all(0 < angle < math.pi for angle in angles):
        return Camera.kinect(*size), (f"its driver states no field of view: a Kinect's intrinsics are assumed{advice}",)
    camera = Camera.from_fov(*size, *angles)
    if abs(camera.fx / camera.fy - 1) > 0.1:
        return camera, (
            f"its field of view does not suit images of {size[0]}x{size[1]} pixels (fx"
            f" {camera.fx:.0f}, fy {camera.fy:.0f}): it may be another camera's{advice}",
        )
    return camera, ()


class Worker:
    """One worker process, at one job.

    Nothing of it can outlive this process: its memory has no name in the file system, and it
    ends when its standard input does, which the system sees to whichever way we end.

    Parameters
    ----------
    job : str
        ``"list"`` or ``"device"``.
    **values
        The job's own parameters, as `worker` reads them.

    Raises
    ------
    RuntimeMissingError
        If OpenNI2 is not installed.
    """

    def __init__(self, job: str, **values: object) -> None:
        runtime = find_runtime()
        self._memory, name, descriptors = _anonymous_memory(_SLOTS * _SLOT_BYTES)
        noisy = bool(os.environ.get("SELECTIVE_DEPTH_DEBUG"))
        try:
            self._process = subprocess.Popen(
                # -P: the current folder must not offer modules to a process of ours.
                [sys.executable, "-P", str(Path(__file__).with_name("worker.py"))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=None if noisy else subprocess.DEVNULL,
                pass_fds=descriptors,
                # Ctrl-C in a terminal goes to a whole process group; the worker must not see it.
                process_group=0,  # which Windows steps over, as others do a flag of 0
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        self._inbox: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, name="openni-reader", daemon=True)
        self._reader.start()
        shared = {"memory": name, "slots": _SLOTS, "slot_bytes": _SLOT_BYTES}
        self._tell(json.dumps({"job": job, "library": str(runtime.path), **shared, **values}))

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None if none comes in time.

        After the worker's death this is ``{"kind": "died", "reason": …}``, once.
        """
        try:
            return self._inbox.get(timeout=max(timeout_s, 0))
        except queue.Empty:
            return None

    def take(self, frame: Message, width: int, height: int) -> DepthArray:
        """Copy a ``frame`` message's image out of the shared memory and free its slot."""
        pixels = np.frombuffer(self._memory, np.uint16, width * height, offset=frame["slot"] * _SLOT_BYTES)
        image = pixels.reshape(height, width).copy()
        self._tell(f"free {frame['slot']}")
        return image

    def take_colour(self, image: Message, about: Message) -> ColourArray | None:
        """The same of a ``colour`` message's image, as red, green and blue."""
        data = memoryview(self._memory)[image["slot"] * _SLOT_BYTES :][:_SLOT_BYTES]
        with data:
            colour = rgb_of(data, about["form"], about["width"], about["height"])
        self._tell(f"free {image['slot']}")
        return colour

    def close(self, grace_s: float = 0.0) -> None:
        """End the process: let it finish for so long, then kill it. Harmless when called twice."""
        with contextlib.suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        self._memory.close()

    def _tell(self, line: str) -> None:
        # A worker that died is noticed by its last message, not here.
        with contextlib.suppress(OSError, ValueError):
            assert self._process.stdin is not None
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as answers:
            for line in answers:
                if line.endswith(b"\n"):  # else it died while writing it
                    self._inbox.put(json.loads(line))
        self._inbox.put({"kind": "died", "reason": _death(self._process.wait())})


def _death(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"OpenNI2 crashed ({signal.Signals(-code).name})"
    return f"the OpenNI2 process ended with code {code}"


def _anonymous_memory(size: int) -> tuple[mmap.mmap, int | str, tuple[int, ...]]:
    """Memory to share with a child: the map, how the child finds it, descriptors to pass on."""
    if sys.platform == "win32":
        name = f"selective-depth-{uuid.uuid4()}"
        return mmap.mmap(-1, size, tagname=name), name, ()
    if sys.platform == "linux":
        descriptor = os.memfd_create("selective-depth")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return mmap.mmap(descriptor, size), descriptor, (descriptor,)
