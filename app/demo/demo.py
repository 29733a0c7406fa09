"""`demo`: a run that is seen and steered in a browser."""

from __future__ import annotations

import importlib.util
import secrets
import webbrowser
from dataclasses import replace

from selective_depth.app.commands.run import run_with_keys
from selective_depth.app.commands.samples import bundled_recording
from selective_depth.app.commands.session import Session
from selective_depth.app.commands.steering import Steering
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.progress import waiting
from selective_depth.app.pipeline import FrameResult, Pipeline, say
from selective_depth.app.settings import DemoOptions, Settings
from selective_depth.app.viewer import own_address, serving_web_viewer, stream_port
from selective_depth.drivers.errors import SourceError
from selective_depth.drivers.frame import DepthFrame

EVERYONE, ITSELF = "0.0.0.0", "127.0.0.1"


def run_demo(source: str | None, options: DemoOptions, settings: Settings) -> int:
    """Run a source, steered from a page in a browser, until Ctrl-C or the page's button.

    Parameters
    ----------
    source : str or None
        As for `open_source`; by default a sensor that is plugged in, else the bundled recording in a loop.
    options : DemoOptions
        Where the page is.
    settings : Settings
        What the run begins with.

    Returns
    -------
    int
        Exit code, as for `watch`.

    Raises
    ------
    UsageError
        If what the page is made with is not installed.
    ViewerError
        If the viewer for browsers or the page does not start.
    """
    if importlib.util.find_spec("nicegui") is None:
        raise UsageError(
            "'demo' needs NiceGUI for its page, which is not installed: pip install 'selective-depth[demo]'."
        )
    from selective_depth.app.demo.page import serving_page  # imports half a second of it

    uri = source or _default_source()
    host = EVERYONE if options.share else ITSELF
    stream, token = stream_port(host), secrets.token_urlsafe(12) if options.share else ""
    play = replace(settings.play, loop=True, realtime=True)
    steering = Steering()
    reached = own_address() if options.share else ITSELF
    with serving_web_viewer(host, stream) as viewer_port:
        seen = replace(
            settings.viewer,
            headless=True,
            serve=True,
            serve_address=f"{host}:{stream}",
            serve_origin=f"http://{reached}:{viewer_port}",  # besides localhost's, which always may
        )
        session = Session(uri, replace(settings, viewer=seen, play=play), steering)
        with serving_page(steering, uri, host, options.port, (viewer_port, stream), token) as port:
            address = f"http://{reached}:{port}/{f'?token={token}' * bool(token)}"

            def prepare(pipeline: Pipeline, frame: DepthFrame) -> FrameResult:
                """Say where the page is, now that there is something to see; compile all that can be switched to."""
                if options.share:
                    say(
                        f"Open in this network: the page on port {port}, to those who have its address with the token;"
                        f" the viewer on port {viewer_port} and the stream it shows on port {stream}, to everyone."
                    )
                say(f"The page is at {address} ; Ctrl-C ends.")
                if not options.share and not options.no_browser:
                    webbrowser.open(address)
                pipeline.warm_up(frame)
                pipeline.warm_up_all(frame)
                return pipeline.warm_up(frame)

            session.prepare = prepare
            return run_with_keys(session)


def _default_source() -> str:
    """The sensor that is plugged in, or what comes with the program."""
    from selective_depth.drivers.openni import list_devices

    try:
        with waiting("Asking OpenNI2 for its sensors"):
            if list_devices():
                return "openni"
    except SourceError as error:
        say(f"No sensor: {error}")
    say("The bundled recording is shown, in a loop.")
    return bundled_recording()
