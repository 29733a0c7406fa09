"""The recordings that come with the program."""

from __future__ import annotations

from pathlib import Path

from selective_depth.app.pipeline import say
from selective_depth.drivers.errors import RuntimeMissingError, SourceNotFoundError

DEMO = "workstation"


def bundled_recording() -> str:
    """The sample recording: the .oni, or its PNG twin where OpenNI2 is not installed.

    Raises
    ------
    SourceNotFoundError
        If the program was installed without its recordings.
    """
    from selective_depth.drivers.openni.runtime import find_runtime

    # Beside `app` in the checkout as in the installed package.
    folder = Path(__file__).parents[2] / "recordings"
    recording, twin = folder / f"{DEMO}.oni", folder / DEMO
    try:
        find_runtime()
    except RuntimeMissingError:
        if twin.is_dir():
            say(f"No OpenNI2 runtime here: replaying {twin.name}/, the same frames as PNG files.")
            return str(twin)
    if not recording.exists():
        raise SourceNotFoundError(
            "the sample recording is not installed. Replay 'virtual:workstation', a made scene,"
            " or a recording of your own."
        )
    return str(recording)
