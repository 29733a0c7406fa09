"""The commands that deal with sensors alone: what is there, and recording it."""

from __future__ import annotations

from pathlib import Path

from selective_depth.app.console import interrupt
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.exit_codes import FAILED, INTERRUPTED, OK
from selective_depth.app.console.progress import FrameProgress, waiting
from selective_depth.app.pipeline import say
from selective_depth.drivers.openni import find_runtime, record, survey, usb_advice

UNKNOWN_ADVICE = (
    "Is it plugged in and powered? A Kinect for Xbox 360 needs libfreenect's OpenNI2 driver beside"
    " the others; see 'Attach a sensor' in the README."
)


def print_devices() -> int:
    """Print the sensors that OpenNI2 finds.

    Returns
    -------
    int
        Exit code: 0, or 1 if there is none.
    """
    runtime = find_runtime()
    with waiting("Asking OpenNI2 for its sensors"):
        found, version = survey()
    say(f"OpenNI2 {version}, {runtime.path}")
    say(f"drivers: {', '.join(runtime.drivers) or 'none'}")
    for file in runtime.not_loaded:
        say(f"not loaded: {file}; the runtime loads {runtime.pattern} only. Copy it to such a name.")
    if not found:
        say(f"no sensor found. {usb_advice(runtime.drivers) or UNKNOWN_ADVICE}")
        return FAILED
    rows = []
    for each in found:
        usb = f"{each.usb_vendor_id:04x}:{each.usb_product_id:04x}" if each.usb_vendor_id else ""
        rows.append((each.uri, each.vendor, each.name, usb))
    print_table(rows, ("device", "vendor", "name", "USB"), "l")
    return OK


def record_sensor(out: Path, device: str, *, frames: int | None, seconds: float | None, overwrite: bool) -> int:
    """Record a sensor and say what became of it.

    Returns
    -------
    int
        Exit code: 0, 1 if frames are missing, 130 after Ctrl-C.
    """
    interrupt.check()
    interrupt.patience_s = interrupt.SAVE_S
    with FrameProgress(f"Recording {out}", frames) as progress:
        report = record(out, device, frames=frames, duration_s=seconds, progress=progress.update, overwrite=overwrite)
    say(f"wrote {out}: {report.frames} frames, read back; it took {report.seconds:.1f} s")
    if report.problem:
        say(f"note: {report.problem}")
    if report.ended == "interrupted":
        return INTERRUPTED
    if report.ended != "done":
        say(f"note: it ended early: {report.ended}")
        return FAILED
    return FAILED if report.problem else OK
