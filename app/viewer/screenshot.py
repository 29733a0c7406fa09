"""Pictures of the viewer: a recording in an invisible one."""

from __future__ import annotations

import socket
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import UsageError, ViewerError
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.window import local_url, start

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_MAGIC = b"RRF2"
BIRTH_S = 20.0
"""How long a viewer may take to start."""
LOAD_S = 5.0
"""How long a viewer may show nothing while it is loading nothing."""
PAINT_S = 30.0
"""How long it may take to paint what it has loaded."""


def screenshot(
    recording: Path,
    frame: int | None = None,
    *,
    time_s: float | None = None,
    view: str | None = None,
    size: tuple[int, int] = (1920, 1080),
) -> npt.NDArray[np.uint8]:
    """Show a recording in an invisible viewer and take its picture.

    Parameters
    ----------
    recording : Path
        An .rrd that `--save` wrote.
    frame : int, optional
        Frame to show; by default the last.
    time_s : float, optional
        Instead of a frame: seconds since the first one.
    view : str, optional
        Title of the one view to show, or a part of it; by default all of them.
    size : tuple of int, default (1920, 1080)
        Width and height of the window; one view alone is a little smaller.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        The window or the view, blue-green-red.

    Raises
    ------
    UsageError
        If the recording has no such frame, time or view.
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
            f"'{recording}' is not a Rerun recording; 'selective-depth replay SOURCE --save FILE.rrd' makes one."
        )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    with ExitStack() as stack:
        try:
            with interrupt.deferred():
                process, _ = start(
                    port, ViewerOptions(viewer_memory="75%"), "--headless", "--window-size", f"{size[0]}x{size[1]}",
                    patience_s=BIRTH_S,
                )  # fmt: skip
                stack.callback(process.wait)
                stack.callback(process.kill)
        except ViewerError as error:
            raise ViewerError(f"{error} A graphics driver: apt-get install mesa-vulkan-drivers libvulkan1.") from None
        client = ViewerClient.connect(local_url(port))
        _load(client, recording, frame, time_s)
        return _settled_picture(client, None if view is None else _maximised(client, view))


def _load(client: ViewerClient, recording: Path, frame: int | None, time_s: float | None) -> None:
    """Open a recording in a viewer and wait until all of it is there, at a frame or time if asked."""
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
    spans = {each.name: (each.start, each.end) for each in shown[0].timelines}
    for timeline, asked, unit in (("frame", frame, 1), ("time", time_s, 1e9)):
        if asked is None:
            continue
        first, last = spans.get(timeline, (None, None))
        if first is None or last is None:
            raise UsageError(f"--{timeline} is {asked:g}, but '{recording}' has no {timeline}s.")
        if not first <= asked * unit <= last:
            ends = f"{first / unit:g}..{last / unit:g}"
            raise UsageError(f"--{timeline} is {asked:g}; the {timeline}s of '{recording}' are {ends}.")
        if timeline == "frame":  # paused: else it plays on to the end
            client.set_time(timeline, sequence=int(asked), play_state="paused")
        else:
            client.set_time(timeline, duration=asked, play_state="paused")


def _maximised(client: ViewerClient, title: str) -> str:
    """Let one view have the whole window; returns its id."""
    views = sorted(client.get_state().views, key=lambda each: each.name)
    views = [each for each in views if each.view_class != "2D" or not each.name.endswith(": lines")]
    for like in (str.__eq__, str.__contains__):
        found = [each.view_id for each in views if like(each.name.lower(), title.lower())]
        if found:
            shown = client.get_blueprint("recording")
            shown.blueprint["/viewport"]["ViewportBlueprint"]["maximized"] = found[0]
            client.set_blueprint(shown.blueprint, of="recording")
            return found[0]
    raise UsageError(f"--view is '{title}'; there are: {', '.join(each.name for each in views)}.")


def _settled_picture(client: ViewerClient, view: str | None) -> npt.NDArray[np.uint8]:
    """The viewer's window, or a view, once it does not change any more: it tells nobody when it is done."""
    deadline_s = time.monotonic() + PAINT_S
    before, now = b"", client.take_screenshot(view)
    while now != before and time.monotonic() < deadline_s:
        time.sleep(0.5)
        before, now = now, client.take_screenshot(view)
    taken = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR)
    if taken is None:
        raise ViewerError("the viewer made no picture. Look at the recording with 'rerun' instead.")
    return np.asarray(taken, dtype=np.uint8)
