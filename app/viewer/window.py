"""The viewer window: who listens on a port, finding a window that is open, starting one."""

from __future__ import annotations

import importlib.util
import os
import queue
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Container
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import rerun as rr

from selective_depth.app.console.errors import ViewerError
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.owner import SCREENS, owner_of

PORTS = range(9876, 9886)
"""Where windows and servers are looked for and put; the first is Rerun's own default."""
PROBE_S = 0.3
"""How long an address is tried. Where no viewer listens the SDK itself would block for 5 s
and lose what is logged."""
ASK_S = 3.0
"""How long a viewer may take to say what it is; it answers between two of its pictures."""
ASK_OURS_S = 0.5
"""The same for our own program: its servers, which are to be told apart, answer at once."""
BIRTH_S = 5.0
"""How long a window may take to open before the run goes on."""
TRIES = 3
"""How often another port is tried when another program has taken the chosen one in the meantime."""
_LEAST_GAP_S = 0.05


@dataclass(frozen=True)
class Listener:
    """What listens at an address.

    Attributes
    ----------
    name : str
        What messages call it.
    viewer : bool
        Whether it is a viewer, of whatever version.
    fits : bool
        Whether it is a viewer of this SDK's version, which alone shows all that is logged.
    rerun : bool
        Whether it speaks Rerun's protocol at all, as far as is known.
    silent : bool
        Whether it has not answered in time.
    """

    name: str
    viewer: bool = False
    fits: bool = False
    rerun: bool = True
    silent: bool = False


@dataclass(frozen=True)
class Window:
    """A viewer window, which outlives this program.

    Attributes
    ----------
    url : str
        Where it listens.
    found : bool
        Whether it was open already.
    awake : bool
        Whether it has answered; one that has not may still be opening, or never.
    notes : tuple of str
        What the user should know about how it was found or opened, a sentence each.
    """

    url: str
    found: bool
    awake: bool
    notes: tuple[str, ...] = ()


def has_display() -> bool:
    """Whether there may be a screen for a window; only opening one shows whether it works."""
    if sys.platform in ("win32", "darwin"):
        return True
    return any(os.environ.get(name) for name in SCREENS)


def listens(address: tuple[str, int]) -> bool:
    """Whether somebody accepts connections at an address (host, port)."""
    try:
        with socket.create_connection(address, PROBE_S):
            return True
    except OSError:
        return False


def comes_to_listen(address: tuple[str, int], patience_s: float, alive: Callable[[], bool] = lambda: True) -> bool:
    """Wait until somebody accepts connections at an address; False if that takes too long, or nobody is `alive`."""
    deadline_s = time.monotonic() + patience_s
    while not (there := listens(address)) and alive() and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return there


def local_url(port: int) -> str:
    """A viewer's or server's address on this machine."""
    return f"rerun+http://127.0.0.1:{port}/proxy"


def ask(url: str, patience_s: float = ASK_S) -> Listener | None:
    """Ask what listens at an address that accepts connections; None if it does no more.

    The SDK has no limit for a listener that says nothing, so another thread asks.
    """
    from rerun.experimental import ViewerClient

    answers: queue.SimpleQueue[str | Exception] = queue.SimpleQueue()

    def wait_for_it() -> None:
        try:
            answers.put(ViewerClient.connect(url).get_state().viewer_version or "of no version")
        except (OSError, RuntimeError, ValueError) as error:
            answers.put(error)

    threading.Thread(target=wait_for_it, name="asking the viewer", daemon=True).start()
    try:
        answer = answers.get(timeout=patience_s)
    except queue.Empty:
        return Listener("a program that does not answer", silent=True)
    if isinstance(answer, str):
        fits = answer.split(".")[:2] == rr.__version__.split(".")[:2]
        return Listener(f"a Rerun viewer {answer}", viewer=True, fits=fits)
    if "Unimplemented" in str(answer):
        return Listener("a Rerun server, or an old viewer")
    if "transport error" in str(answer):
        return None
    return Listener("another program", rerun=False)


def get_window(options: ViewerOptions, taken: Container[int] = ()) -> Window:
    """The window that is open, or a new one.

    Only a viewer of this SDK's version counts as one that is open. Anything else on a port
    (another run's server, an old viewer, another program) is left alone.

    Parameters
    ----------
    options : ViewerOptions
        Memory of a new one.
    taken : container of int, optional
        Ports that this run itself will use.

    Raises
    ------
    ViewerError
        If none is open and none starts, with the reason.
    """
    ports = [port for port in PORTS if port not in taken]
    for _ in range(TRIES):
        with ThreadPoolExecutor(len(ports)) as pool:
            there = dict(zip(ports, pool.map(look_at, ports), strict=True))
        found = next((port for port, it in there.items() if it is not None and it.fits), None)
        if found is not None:
            note = (
                "The viewer window that is open is used. It keeps the memory it was started with;"
                " close it for --viewer-memory to count."
            )
            asked = options.viewer_memory != ViewerOptions().viewer_memory
            return Window(local_url(found), found=True, awake=True, notes=(note,) * asked)
        port = next((port for port, it in there.items() if it is None), None)
        if port is None:
            break
        awake = start(port, options)[1]
        if awake is not None:
            notes = tuple(
                f"Port {other} has {it.name}; the viewer window listens on {port}."
                for other, it in there.items()
                if it is not None and other < port
            )
            return Window(local_url(port), found=False, awake=awake, notes=notes)
    raise ViewerError(
        f"the viewer window does not start: the ports {PORTS[0]}..{PORTS[-1]} are all taken by"
        " other programs. End one, or use --save FILE.rrd --headless."
    )


def look_at(port: int) -> Listener | None:
    """What is on a port of this machine; a viewer on another screen, or of another version, does not fit."""
    if not listens(("127.0.0.1", port)):
        return None
    owner, program = owner_of(port), viewer_executable()
    ours = owner.same_screen and program is not None and owner.program == Path(program).resolve()
    listener = ask(local_url(port), ASK_OURS_S if ours else ASK_S)
    if listener is None or (listener.viewer and owner.same_screen):
        return listener
    if listener.viewer:
        return replace(listener, name=f"{listener.name} on another screen", fits=False)
    return replace(listener, fits=ours and listener.silent)


def start(
    port: int, options: ViewerOptions, *more: str, patience_s: float = BIRTH_S
) -> tuple[subprocess.Popen[bytes], bool | None]:
    """Start a viewer, with `more` arguments, and wait until it answers.

    False if it lives but has not answered in time, None if another program had the port first.

    It is started here and not by the SDK, whose `spawn` lets everyone in the network read and
    write, hands it this program's output (so that a pipe from here never ends), and takes 20 s
    to notice that it died.
    """
    executable = needed_executable()
    command = [executable, "--bind", "127.0.0.1", "--port", str(port)]
    command += ["--memory-limit", options.viewer_memory]
    command += ["--server-memory-limit", options.serve_memory]
    command += ["--hide-welcome-screen", "--expect-data-soon", *more]
    # The file has no name and goes with the viewer; only what ends that is written to it.
    with tempfile.TemporaryFile() as complaints:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=complaints,
                start_new_session=True,
                creationflags=getattr(subprocess, "DETACHED_PROCESS", 0),
                env={"RUST_LOG": "error", "RERUN_APP_ONLY": "true"} | os.environ,
            )
        except OSError as error:
            raise ViewerError(f"the viewer window does not start: '{executable}': {error.strerror}.") from None
        try:
            return process, _is_born(process, port, complaints, patience_s)
        except BaseException:
            process.kill()
            process.wait()
            raise


def _is_born(process: subprocess.Popen[bytes], port: int, complaints: IO[bytes], patience_s: float) -> bool | None:
    """Wait until a viewer answers; False and None as for `start`."""
    deadline_s = time.monotonic() + patience_s
    while (left_s := deadline_s - time.monotonic()) > 0:
        if process.poll() is not None:
            if process.returncode == 0 or listens(("127.0.0.1", port)):
                return None  # as it ends where somebody listens already
            raise ViewerError(f"the viewer window does not start: {_reason(process, complaints)}")
        if listens(("127.0.0.1", port)) and owner_of(port).pid in (None, process.pid):
            listener = ask(local_url(port), left_s)
            if listener is not None and listener.viewer:
                return True
        time.sleep(_LEAST_GAP_S)
    if listens(("127.0.0.1", port)):
        return False
    raise ViewerError(f"the viewer window does not start: it does not answer within {patience_s:g} s.")


def _reason(process: subprocess.Popen[bytes], complaints: IO[bytes]) -> str:
    """Why a viewer ended, in its own last words."""
    complaints.seek(0)
    text = complaints.read().decode(errors="replace")
    errors = re.findall(r"^Error: (.+)$|panicked at .*\n(.+)$", text, re.MULTILINE)
    if errors:
        # Without the places in its source code, which say nothing to whoever reads this.
        words = re.sub(r"\bos error at \S+:\d+: ", "", "".join(errors[-1])).strip()
        return f"{words.rstrip('.')}."
    if process.returncode < 0:
        return f"it was ended by signal {-process.returncode}."
    return f"it ended with exit code {process.returncode}."


def viewer_executable() -> str | None:
    """The viewer that came with the SDK, else the first on the PATH; None without any."""
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        folder = Path(package.origin).parent
        bundle = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"  # on macOS
        for native in (bundle, folder / "rerun", folder / "rerun.exe"):
            if native.is_file():
                return str(native)
    return shutil.which("rerun")


def needed_executable() -> str:
    """The viewer that came with the SDK, else the first on the PATH.

    Raises
    ------
    ViewerError
        If there is none, saying how to get it.
    """
    executable = viewer_executable()
    if executable is None:
        raise ViewerError("there is no program 'rerun'. Install it with: pip install --force-reinstall rerun-sdk.")
    return executable


def join_command(url: str) -> str:
    """What to type to see a served stream; with the folder, where `rerun` alone starts another viewer."""
    ours, on_path = Path(sys.executable).with_name("rerun"), shutil.which("rerun")
    plain = not ours.is_file() or (on_path is not None and ours.samefile(on_path))
    return f"{'rerun' if plain else ours} --connect {url}"
