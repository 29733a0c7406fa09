"""`replay` and `live`: options that contradict each other refused, a session run, its report printed."""

from __future__ import annotations

from pathlib import Path

from selective_depth.app.commands.session import Session, beside
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.keys import KEYS, pressed
from selective_depth.app.console.output import check_output, write_output
from selective_depth.app.pipeline import is_settings, print_report, say
from selective_depth.app.settings import AcquireOptions, Settings
from selective_depth.drivers.oni import check_place


def watch(uri: str, settings: Settings) -> int:
    """Run a source through both selectors into the viewer, and print what it came to.

    On a terminal, keys change the acquisition while it runs.

    Parameters
    ----------
    uri : str
        As for `open_source`.
    settings : Settings
        All options.

    Returns
    -------
    int
        Exit code: 0, 1 if something that was asked for failed, 130 after Ctrl-C.
    """
    check(settings)
    seen = settings.viewer
    kept = (seen.save, seen.record, seen.json, seen.table, seen.save_model, seen.serve, seen.connect)
    if seen.headless and not any(kept):
        say("Nothing is kept of this run but the report below; --save FILE.rrd, --json or --table keeps it.")
    session = Session(uri, settings)
    code = run_with_keys(session)
    if seen.json is not None:
        write_output(seen.json, session.report.to_json(settings))
    return code


def run_with_keys(session: Session) -> int:
    """Run a session, which keys of the terminal steer, and print its report; returns the exit code."""
    with pressed(session.steering.press) as keys:
        code = session.run(KEYS if keys else "")
    print_report(session.report)
    return code


def check(settings: Settings) -> None:
    """Refuse options that contradict each other; the range of each is in its type.

    Raises
    ------
    UsageError
        Naming the option, its value and what is allowed.
    """
    seen, spend = settings.viewer, settings.acquire
    near_mm, far_mm = seen.near_mm or 0, 65535 if seen.far_mm is None else seen.far_mm
    if far_mm <= near_mm:
        raise UsageError(f"--far-mm is {far_mm}; it must be more than --near-mm, {near_mm}.")
    if seen.save is not None:
        _check_save(seen.save, seen.overwrite)
    if seen.record is not None:
        check_place(seen.record, seen.overwrite)
    if seen.table is not None and seen.table.suffix.lower() != ".parquet":
        raise UsageError(f"--table is '{seen.table}'; it must end in .parquet.")
    check_output(seen.json, seen.table)
    if spend.budget:
        return
    if seen.save_model is not None:
        raise UsageError("--save-model writes what a --budget acquires; give one, such as 5%.")
    if spend.rounds != AcquireOptions().rounds:
        raise UsageError(f"--rounds is {spend.rounds}, but nothing is spent in them; give a --budget, such as 5%.")


def _check_save(path: Path, overwrite: bool) -> None:
    """Refuse a name that is not a Rerun recording's, or that would replace what is there."""
    if path.suffix.lower() != ".rrd":
        raise UsageError(f"--save is '{path}'; it must end in .rrd, as Rerun recordings do.")
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UsageError(f"--save is {str(path)!r}; Rerun writes names in UTF-8 only.") from None
    if path.is_file() and path.stat().st_size and not overwrite:
        raise UsageError(f"--save is '{path}', which exists already; give another name, or --overwrite.")
    settings, picture = beside(path)
    ours = settings.is_file() and is_settings(settings)
    for each in (settings, picture):
        if each.exists() and not ours:
            raise UsageError(
                f"--save is '{path}', but '{each}', which would be replaced by what is written"
                " beside it, is not of an earlier run. Give another name."
            )
