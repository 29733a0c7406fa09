"""The child's end of the link to the process that started it: jobs, answers, shared memory.

Imported by `worker`, which runs as a script: so it needs nothing of the package either. When the
parent goes, whichever way, standard input ends, and with it the child.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import queue
import sys
import threading
import time
from typing import Any

LEAVE_S = 3.0  # from the parent's end to this process's, at most


class JobError(Exception):
    """Ends the job; `kind` is the name of the error that the parent raises.

    A `remedy` is what to do unless the USB bus, where the parent looks, tells more.
    """

    def __init__(self, message: str, *, kind: str = "DeviceRefusedError", remedy: str = "") -> None:
        super().__init__(message)
        self.kind = kind
        self.remedy = remedy


class Parent:
    """Both ends of the conversation with the process that started this one."""

    def __init__(self) -> None:
        # Drivers print on standard output: the answers move to a descriptor of their own.
        self._out = os.dup(1)
        os.dup2(2, 1)
        self._pid = os.getppid()
        self._commands = open(0, "rb", closefd=False)  # noqa: SIM115 - for all its life
        self.free_slots: queue.SimpleQueue[int] = queue.SimpleQueue()
        self.stop = threading.Event()

    def first_job(self) -> dict[str, Any]:
        """What to do; from now on the parent is watched."""
        line = self._commands.readline()
        if not line:
            os._exit(0)
        job: dict[str, Any] = json.loads(line)
        for watch in (self._listen, self._look_after):
            threading.Thread(target=watch, daemon=True).start()
        return job

    def send(self, kind: str, **values: object) -> None:
        """Say one thing."""
        line = memoryview(json.dumps({"kind": kind, **values}).encode() + b"\n")
        try:
            while line:
                line = line[os.write(self._out, line) :]
        except BrokenPipeError:
            self.stop.set()  # there is nobody left to tell, but a recording still has to be ended

    def _listen(self) -> None:
        for line in self._commands:
            word, _, number = line.decode().strip().partition(" ")
            if word == "free":
                self.free_slots.put(int(number))
            else:
                self.stop.set()
        self._leave()  # the pipe is closed: asked to go, or the parent is no more

    def _look_after(self) -> None:
        """Notice the parent's end even if a process that it forked keeps our pipe open."""
        while os.getppid() == self._pid:
            time.sleep(0.5)
        self._leave()

    def _leave(self) -> None:
        """Give a recording the time to end its file; nothing may outlive this, hanging or not."""
        self.stop.set()
        time.sleep(LEAVE_S)
        os._exit(1)


class Slots:
    """The shared memory: equal slots, each free or holding one depth image."""

    def __init__(self, job: dict[str, Any], parent: Parent) -> None:
        size = job["slots"] * job["slot_bytes"]
        if sys.platform == "win32":
            memory = mmap.mmap(-1, size, tagname=job["memory"])
        else:
            memory = mmap.mmap(job["memory"], size)
        self._start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._memory = memory
        self._slot_bytes: int = job["slot_bytes"]
        self._parent = parent
        for slot in range(job["slots"]):
            parent.free_slots.put(slot)

    def take(self) -> int | None:
        """A free slot; None if there is none."""
        try:
            return self._parent.free_slots.get_nowait()
        except queue.Empty:
            return None

    def fill(self, slot: int, address: int, row: int, stride: int, rows: int) -> None:
        """Copy an image from the runtime's memory, which it will use again.

        Of each `stride` bytes there, the first `row` are pixels.
        """
        start = self._start + slot * self._slot_bytes
        if row == stride:
            ctypes.memmove(start, address, row * rows)
        else:
            for number in range(rows):
                ctypes.memmove(start + number * row, address + number * stride, row)

    def fits(self, size: int) -> bool:
        """Whether an image of so many bytes has room."""
        return size <= self._slot_bytes


def forbid_core_dumps() -> None:
    """A crash here is expected; writing its memory out would delay the next start."""
    if os.name == "posix":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
