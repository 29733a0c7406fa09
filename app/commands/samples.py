"""The recordings that come with the program."""

from __future__ import annotations

from pathlib import Path

from selective_depth.drivers.errors import SourceNotFoundError

DEMO = "workstation.oni"


def bundled_recording() -> str:
    """The sample recording.

    Raises
    ------
    SourceNotFoundError
        If the program was installed without its recordings.
    """
    # Beside `app` in the checkout as in the installed package.
    recording = Path(__file__).parents[2] / "recordings" / DEMO
    if not recording.exists():
        raise SourceNotFoundError(
            "the sample recording is not installed. Replay 'virtual:workstation', a made scene,"
            " or a recording of your own."
        )
    return str(recording)
