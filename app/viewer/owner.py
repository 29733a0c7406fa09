"""Whose a port is: the process that listens there, its program, and the screen it is on."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")
_LISTENING = "0A"
_PROC = Path("/proc")


@dataclass(frozen=True)
class Owner:
    """The process that listens on a port of this machine.

    Attributes
    ----------
    pid : int or None
        Its number; None where that is not known: on systems without ``/proc``, and of other
        users' processes.
    program : Path or None
        What it runs; None likewise.
    same_screen : bool
        Whether its windows are where ours would be; false of other users' processes, true where
        the system does not tell.
    """

    pid: int | None
    program: Path | None
    same_screen: bool


def owner_of(port: int) -> Owner:
    """Who listens on a port of this machine, as Linux tells it under ``/proc``."""
    table = _PROC / "net" / "tcp"
    if not table.is_file():
        return Owner(None, None, same_screen=True)
    links = set()
    for line in table.read_text().splitlines()[1:]:
        _, local, _, state, *_, inode = line.split()[:10]
        if state == _LISTENING and int(local.rpartition(":")[2], 16) == port:
            links.add(f"socket:[{inode}]")
    for process in _PROC.glob("[0-9]*"):
        with suppress(OSError):  # another user's, or it has just ended
            if any(str(handle.readlink()) in links for handle in (process / "fd").iterdir()):
                theirs = (process / "environ").read_bytes().split(b"\0")
                program = (process / "exe").resolve()
                same = all(_same(name, theirs) for name in SCREENS)
                return Owner(int(process.name), program, same)
    return Owner(None, None, same_screen=False)


def _same(name: str, theirs: list[bytes]) -> bool:
    start = f"{name}=".encode()
    value = next((os.fsdecode(each[len(start) :]) for each in theirs if each.startswith(start)), "")
    return value.removesuffix(".0") == os.environ.get(name, "").removesuffix(".0")
