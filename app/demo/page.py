"""The page itself: the viewer, the big line, and what can be changed; made with NiceGUI."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from selective_depth.app.commands.steering import Status, Steering
from selective_depth.app.console.errors import ViewerError
from selective_depth.app.demo.guard import Guard
from selective_depth.app.pictures import STATE_COLOURS
from selective_depth.app.pipeline import SELECTOR_NAMES
from selective_depth.app.settings import LAYERS, LAYOUTS, Layer
from selective_depth.app.viewer import free_port, web_address

LOOK_S = 0.2
"""How often the page looks how the run stands."""
HELD_S = 0.7
"""For how long a control that was just moved is not set to what the run says of it: it may not have obeyed yet."""
RECONNECT_S = 60.0
"""For how long a page that is not heard of is kept: a tablet sleeps, a browser paints the viewer in software."""
START_S = 10.0
TITLE = "Selective depth"
Show = Callable[[Any], Any]
LABELS = {
    "auto": "best there is",
    "surface": "surface score",
    "step": "step score",
    "improvement": "improvement map",
    "neural-gas": "neural gas",
    "neural-gas-edges": "neural gas, long edges",
    "even": "even lattice",
}
"""What selectors are called on the page."""


@contextmanager
def serving_page(
    steering: Steering, source: str, host: str, port: int, viewer: tuple[int, int], token: str
) -> Iterator[int]:
    """Serve the page while what is inside runs, in a thread; yields its port.

    Parameters
    ----------
    steering : Steering
        What the controls ask, and what is shown.
    source : str
        What is run, for the page to name.
    host : str
        Address to listen at.
    port : int
        Port to begin to look for a free one at.
    viewer : tuple of int
        Ports of the viewer for browsers, and of the stream it shows.
    token : str
        What has to be known to be let in; empty where only this machine is answered to.

    Raises
    ------
    ViewerError
        If no port is free, or it does not start.
    """
    port = free_port(host, range(port, port + 10))
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    def page() -> None:
        request = ui.context.client.request
        ui.dark_mode(True)
        url = web_address(request.url.hostname or "127.0.0.1", *viewer)
        _Page(steering, source, url).build(request.query_params.get("viewer") != "off")

    ui.page("/", title=TITLE)(page)
    ui.run_with(app, title=TITLE, show_welcome_message=False, reconnect_timeout=RECONNECT_S)
    options: dict[str, Any] = {"log_level": "critical", "access_log": False, "timeout_graceful_shutdown": 1}
    server = uvicorn.Server(uvicorn.Config(Guard(app, token), host, port, **options))
    thread = threading.Thread(target=server.run, name="page", daemon=True)
    thread.start()
    deadline_s = time.monotonic() + START_S
    while not server.started:
        if not thread.is_alive() or time.monotonic() > deadline_s:
            raise ViewerError(f"the page does not start on {host}:{port}.")
        time.sleep(0.02)
    try:
        yield port
    finally:
        server.should_exit = True
        thread.join(START_S)


class _Page:
    """One browser's page."""

    def __init__(self, steering: Steering, source: str, viewer_url: str) -> None:
        self._steering = steering
        self._source = source
        self._viewer_url = viewer_url
        self._synced: list[Callable[[Status], None]] = []

    def build(self, seen: bool) -> None:
        """Put everything in its place, the viewer too if it is to be seen, and keep it up to date."""
        ui.query(".nicegui-content").classes("p-0 gap-0")
        with ui.row().classes("w-full h-screen no-wrap gap-0"):
            with ui.column().classes("h-screen overflow-y-auto p-3 gap-2 no-wrap shrink-0").style("width: 270px"):
                ui.label(TITLE).classes("text-lg font-bold")
                self._state()
                self._controls()
                self._buttons()
                below = ui.column().classes("w-full gap-2")
            with ui.column().classes("h-screen grow gap-0 no-wrap min-w-0"):
                self._line()
                frame = ui.element("div").classes("w-full grow")
            with below:
                self._viewer(frame, seen)
                self._news()
        self._look()
        ui.timer(LOOK_S, self._look)

    def _look(self) -> None:
        status = self._steering.status
        if status is not None:
            for each in self._synced:
                each(status)

    def _text(self, text: Callable[[Status], str], classes: str, name: str) -> ui.label:
        label = ui.label().classes(classes).mark(name).props(f'data-name="{name}"')
        self._synced.append(lambda status: label.set_text(text(status)))
        return label

    def _control(self, element: Any, name: str, of: Show, to: Callable[[Any], Any] = lambda x: x) -> None:
        """Ask for what a control is set to by hand, and set it to what holds; `to` turns one into the other."""
        moved_s = 0.0

        def ask() -> None:
            nonlocal moved_s
            status, wish = self._steering.status, to(element.value)
            if status is None or wish == to(of(status)):
                return
            moved_s = time.monotonic()
            self._steering.ask(name, wish)

        def follow(status: Status) -> None:
            if time.monotonic() - moved_s > HELD_S and element.value != of(status):
                element.set_value(of(status))

        element.props(f'data-name="{name}"').on_value_change(ask)
        self._synced.append(follow)

    def _state(self) -> None:
        with ui.row().classes("items-center gap-2 no-wrap"):
            dot = ui.icon("circle").classes("text-sm")

            def colour(status: Status) -> None:
                packed = STATE_COLOURS.get(status.state.partition(":")[0], 0x999999FF)
                dot.style(f"color: #{packed >> 8:06x}")

            self._synced.append(colour)
            self._text(lambda s: "ended" if s.ended else "paused" if s.paused else s.state, "text-sm", "state")
        ui.label(self._source.rstrip("/").rpartition("/")[2]).classes("text-xs text-gray-400 break-all")
        self._text(lambda s: f"{s.fps:.0f} frames/s · {s.frames:,} frames · {s.skipped:,} skipped", "text-xs", "rate")
        self._text(
            lambda s: f"left out to keep up: {s.given_up}" if s.given_up else "", "text-xs text-amber-400", "left-out"
        )

    def _controls(self) -> None:
        self._text(lambda s: f"Budget: {s.acquire.budget:.1%} of the pixels", "text-sm", "budget-text")
        slider = ui.slider(min=0, max=20, step=0.5, value=0).props("dense")
        self._control(slider, "budget", lambda s: round(200 * s.acquire.budget) / 2, lambda percent: percent / 100)
        self._text(lambda s: f"Rounds: {s.acquire.rounds}", "text-sm", "rounds-text")
        rounds = ui.slider(min=1, max=16, step=1, value=1).props("dense")
        self._control(rounds, "rounds", lambda s: s.acquire.rounds, int)
        by = ui.select(LABELS, label="Shots chosen by", value="auto").classes("w-full").props("dense outlined")
        self._control(by, "by", lambda s: s.acquire.by if s.acquire.by in SELECTOR_NAMES else None)
        memory = ui.switch("Memory (camera stands still)").props("dense")
        self._control(memory, "memory", lambda s: s.acquire.memory == "still", lambda on: "still" if on else "off")
        layout = ui.toggle(list(LAYOUTS), value="visitor").props("dense no-caps spread").classes("w-full")
        self._control(layout, "layout", lambda s: s.viewer.layout)
        shown = ui.select(list(LAYERS), label="Layers", multiple=True, value=list(LAYERS))
        shown.classes("w-full").props("dense outlined")
        self._control(shown, "hide", lambda s: list(_others(s.viewer.hide)), _others)

    def _buttons(self) -> None:
        with ui.row().classes("w-full gap-2"):
            self._toggle("paused", ("Pause", "pause"), ("Go on", "play_arrow"), lambda s: s.paused)
            self._button("reset", "Reset", "restart_alt", lambda: self._steering.ask("reset"))
        with ui.row().classes("w-full gap-2"):
            self._toggle("recording", ("Record", "fiber_manual_record"), ("Stop", "stop"), lambda s: s.recording)
            self._button("snapshot", "Picture", "photo_camera", lambda: self._steering.ask("snapshot"))

    def _button(self, name: str, text: str, icon: str, act: Callable[[], None]) -> ui.button:
        made = ui.button(text, icon=icon, on_click=act).props(f'dense no-caps outline data-name="{name}"')
        return made.classes("grow")

    def _toggle(self, name: str, off: tuple[str, str], on: tuple[str, str], of: Callable[[Status], bool]) -> None:
        """A button for what is off or on, with the text and the icon of what a click does."""

        def click() -> None:
            if self._steering.status is not None:
                self._steering.ask(name, not of(self._steering.status))

        button = self._button(name, *off, click)

        def follow(status: Status) -> None:
            text, icon = on if of(status) else off
            button.set_text(text)
            button.set_icon(icon)

        self._synced.append(follow)

    def _news(self) -> None:
        self._text(lambda s: "\n".join(s.news), "text-xs text-gray-400 whitespace-pre-line break-words", "news")

    def _line(self) -> None:
        text = "text-2xl font-bold px-4 py-2 whitespace-nowrap overflow-hidden"
        line = self._text(lambda s: s.gain or "…", text, "gain")
        line.style("font-size: min(1.9rem, 2.1vw)")

    def _viewer(self, frame: Any, seen: bool) -> None:
        """The viewer; hidden it takes no time, which matters where browser and run share a machine."""

        def show(on: bool) -> None:
            frame.clear()
            if on:
                with frame:
                    source = f'src="{self._viewer_url}" title="viewer" data-name="viewer"'
                    ui.element("iframe").props(source).classes("w-full h-full border-0")

        ui.switch("Viewer", value=seen, on_change=lambda event: show(event.value)).props('dense data-name="seen"')
        show(seen)


def _others(layers: Sequence[Layer]) -> tuple[Layer, ...]:
    """The layers that are not among these: what is hidden where these are shown, and the other way round."""
    return tuple(layer for layer in LAYERS if layer not in layers)
