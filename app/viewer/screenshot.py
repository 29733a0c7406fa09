"""Pictures of the viewer: a recording in an invisible one."""

from __future__ import annotations

import os
import socket
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import UsageError, ViewerError
from selective_depth.app.viewer.window import viewer_executable

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_MAGIC = b"RRF2"
LOAD_S = 5.0
"""How long a viewer may show nothing while it is loading nothing."""
PAINT_S = 30.0
"""How long it may take to paint what it has loaded."""


def screenshot(recording: Path, frame: int | None = None) -> npt.NDArray[np.uint8]:
    """Show a recording in an invisible viewer and take its picture.

    Parameters
    ----------
    recording : Path
        An .rrd that `--save` wrote.
    frame : int, optional
        Frame to show; default the last.

    Returns
    -------
    uint8 array of shape (1080, 1920, 3)
        The window, blue-green-red.

    Raises
    ------
    UsageError
        If the recording has no such frame.
    ViewerError
        If there is no such recording, or the viewer does not run here; it needs a graphics driver
        (Mesa's lavapipe will do).
    """
    from rerun.experimental import ViewerClient

    try:
        with recording.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except OSError as error:
        raise ViewerError(f"'{recording}' cannot be shown: {error.strerror}.") from None
    if magic != _MAGIC:
        raise ViewerError(
            f"'{recording}' is no Rerun recording; 'selective-depth replay SOURCE --save FILE.rrd' makes one."
        )
    # The viewer complains on the terminal where there is none, as on a server.
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    with ExitStack() as stack:
        try:
            with interrupt.deferred():
                client = ViewerClient.spawn(
                    headless=True, port=port, hide_welcome_screen=True, executable_path=viewer_executable()
                )
                stack.callback(client.quit)
        except RuntimeError as error:
            raise ViewerError(
                f"the viewer does not start ({str(error).splitlines()[0]}). Install a graphics"
                " driver: apt-get install mesa-vulkan-drivers libvulkan1."
            ) from None
        _load(client, recording, frame)
        return _settled_picture(client)


def _load(client: ViewerClient, recording: Path, frame: int | None) -> None:
    """Open a recording in a viewer and wait until all of it is there, at a frame if asked."""
    client.open(str(recording.resolve()))
    deadline_s = time.monotonic() + LOAD_S
    while True:
        state = client.get_state()
        shown = [each for each in state.recordings if each.store_id == state.active_recording]
        if shown and not state.loading:
            break
        if state.loading:
            deadline_s = time.monotonic() + LOAD_S
        elif time.monotonic() > deadline_s:
            raise ViewerError(f"the viewer finds nothing to show in '{recording}'.")
        time.sleep(0.1)
    if frame is None:
        return
    spans = {each.name: (each.start, each.end) for each in shown[0].timelines}
    first, last = spans.get("frame", (None, None))
    if first is None or last is None:
        raise UsageError(f"--frame is {frame}, but '{recording}' has no frames, only other times.")
    if not first <= frame <= last:
        raise UsageError(f"--frame is {frame}; the frames of '{recording}' are {first}..{last}.")
    client.set_time("frame", sequence=frame, play_state="paused")  # else it plays on to the end


def _settled_picture(client: ViewerClient) -> npt.NDArray[np.uint8]:
    """The viewer's window, once it does not change any more: it tells nobody when it is done."""
    deadline_s = time.monotonic() + PAINT_S
    before, now = b"", client.take_screenshot()
    while now != before and time.monotonic() < deadline_s:
        time.sleep(0.5)
        before, now = now, client.take_screenshot()
    taken = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR)
    if taken is None:
        raise ViewerError("the viewer made no picture. Look at the recording with 'rerun' instead.")
    return np.asarray(taken, dtype=np.uint8)
