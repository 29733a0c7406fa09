"""The commands that deal with recordings as files: what is wrong with one, and saving frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

from selective_depth.app.archive import Recording, recordings
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import FAILED, OK
from selective_depth.app.console.output import make_folder
from selective_depth.app.console.progress import FrameProgress, waiting
from selective_depth.app.pipeline import Feed, open_and_tell, say
from selective_depth.drivers.bag import BagWriter
from selective_depth.drivers.errors import SourceError
from selective_depth.drivers.folder import FolderWriter
from selective_depth.drivers.oni import OniReader, OniReport, OniWriter, inspect_oni, repair_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.options import parted
from selective_depth.drivers.search import FILES
from selective_depth.drivers.writer import FrameWriter

MOST_PROBLEMS = 20
LOOK_S = 600.0
"""For so long at most a recording is looked at before it is exported."""
OTHER_FILES = (".npz", ".npy", ".png", ".rrd", ".ply", ".bag", ".db3", ".pdf", ".svg", ".webp")
"""Endings of files that a folder's name must not have by mistake."""
BAGS = (".mcap", ".ros2")
"""Endings of an MCAP file, and of the folder of a ROS 2 bag."""


def check(sources: Sequence[str], *, repair: Path | None, timeout_s: float) -> int:
    """Print what is wrong with recordings: all about one .oni file, or a line of each of several.

    Returns
    -------
    int
        Exit code: 0 if nothing is wrong (or a repaired file was written), else 1.
    """
    found = list(recordings(sources))
    if len(found) == len(sources) == 1 and not Path(found[0].source).is_dir():
        return check_file(Path(parted(sources[0])[0]), repair=repair, timeout_s=timeout_s)
    if repair is not None or not found:
        raise UsageError(
            "--repair takes one .oni file; name that file alone."
            if found
            else "no recording was named; give files or folders."
        )
    return _several("Checking", found, lambda each: _look(each.source, timeout_s))


def _several(doing: str, found: Sequence[Recording], do: Callable[[Recording], tuple[int, str]]) -> int:
    """Do something with each of several recordings and print what came of it; returns the exit code."""
    rows: list[tuple[str, str, str]] = []
    wrong = 0
    with FrameProgress(doing, None) as progress:
        for at, each in enumerate(found, start=1):
            try:
                frames, trouble = do(each)
            except SourceError as error:
                frames, trouble = 0, str(error)
            wrong += bool(trouble)
            rows.append((each.name, f"{frames:,}", trouble or "whole"))
            progress.update(at, f"of the recording{'s' * (len(found) > 1)}")
    print_table(rows, ("recording", "frames", ""), justify="lrl")
    say(f"{len(found):,} recording{'s' * (len(found) != 1)}, {wrong:,} not whole")
    return FAILED if wrong else OK


def _look(source: str, timeout_s: float) -> tuple[int, str]:
    """How many frames are readable, and what is wrong."""
    path = Path(parted(source)[0])
    if path.suffix.lower() == ".oni":
        report = inspect_oni(path, decode=True, timeout_s=timeout_s)
        return report.readable_frames, "" if report.complete else _verdict(report)
    with open_source(source) as opened:
        if opened.frame_count is None:
            raise SourceError(f"'{source}' never ends, so it cannot be checked; record some of it first.")
        feed = Feed(opened)
        frames = sum(1 for _ in feed)
        return frames, str(feed.damage or opened.damage or "" if frames else f"'{source}' holds no frame")


def check_file(path: Path, *, repair: Path | None, timeout_s: float) -> int:
    """Print what is in an .oni file and what is wrong with it; save what is readable if asked.

    Returns
    -------
    int
        Exit code: 0 if nothing is wrong (or a repaired file was written), else 1.
    """
    with waiting(f"Checking {path}"):
        report = inspect_oni(path, decode=True, timeout_s=timeout_s)
    _print_check(report)
    if repair is not None:
        with waiting(f"Writing {repair}"):
            mended = repair_oni(path, repair)
        say(f"wrote {repair}: {mended.readable_frames} depth frames, whole")
        return OK
    if report.swapped_frames:
        say(
            f"note: OpenNI2's recorder swapped the last pixels of {report.swapped_frames} frames; they are read rightly"
            " here, but its own player shows them wrong. --repair OUT.oni writes a file without the flaw"
        )
    for note in report.notes:
        say(f"note: {note}")
    if not report.complete and report.readable_frames:
        say(
            f"note: save what is readable with --repair OUT.oni, or as PNG files with"
            f" 'selective-depth export {path} FOLDER'"
        )
    return OK if report.complete else FAILED


def export_all(paths: Sequence[str], frames: int | None) -> int:
    """Export one source, or each of several into a folder of its own below the last path.

    Returns
    -------
    int
        Exit code: 0, or 1 if one of several is not whole or cannot be written.
    """
    if len(paths) < 2:
        raise UsageError("give what to export and where to, as in: export walk.oni frames/")
    *sources, last = paths
    out = Path(last)
    found = list(recordings(sources, out))
    if len(found) == len(sources) == 1 and Path(found[0].source) in (Path(sources[0]), Path(sources[0]).absolute()):
        return export(sources[0], out, frames)
    make_folder(out)

    def save(each: Recording) -> tuple[int, str]:
        folder = out / Path(each.name).with_suffix("") if each.name.lower().endswith(FILES) else out / each.name
        make_folder(folder.parent)
        oni = parted(each.source)[0].lower().endswith(".oni")  # of which all that is readable is saved
        trouble = _look(each.source, LOOK_S)[1] if oni else ""
        return _export(each.source, folder, frames, FrameProgress(each.name, None)), trouble

    return _several(f"Writing {out}", found, save)


def export(source: str, out: Path, frames: int | None) -> int:
    """Save the frames of any source as a folder of PNG files, an .oni file or a ROS 2 bag.

    Of an .oni file that is damaged, all that is readable is saved.

    Returns
    -------
    int
        Exit code 0.
    """
    ending = out.suffix.lower()
    if ending in OTHER_FILES:
        raise UsageError(
            f"'{out}' ends in {ending}, which export does not write; give the name of a folder, for"
            " PNG files, or one that ends in .oni, .mcap or .ros2."
        )
    with FrameProgress(f"Writing {out}", frames) as progress:
        count = _export(source, out, frames, progress)
    say(f"wrote {out}: {count} frames")
    return OK


def _export(source: str, out: Path, frames: int | None, progress: FrameProgress) -> int:
    """Save them; returns how many."""
    ending = out.suffix.lower()
    recording = Path(source).suffix.lower() == ".oni"
    if recording and ending == ".oni" and frames is None:
        return repair_oni(source, out).readable_frames
    salvaged = recording and ending not in (".oni", *BAGS)
    count = 0
    with OniReader(source, salvage=True) if salvaged else open_and_tell(source) as opened:
        for note in opened.notes if not salvaged else ():
            say(f"note: {note}")
        if opened.frame_count is None and frames is None:
            raise UsageError(f"'{source}' never ends; say how many frames to save, as in --frames 100.")
        with _writer(out, opened.fps) as writer:
            for count, frame in enumerate(islice(opened, frames), start=1):
                writer.write(frame)
                progress.update(count)
    return count


def _writer(out: Path, fps: float) -> FrameWriter:
    ending = out.suffix.lower()
    if ending in BAGS:
        return BagWriter(out)
    return OniWriter(out, fps=fps) if ending == ".oni" else FolderWriter(out, fps=fps)


def _print_check(report: OniReport) -> None:
    say(str(report.path))
    rows = [("size", f"{report.size_bytes:,}", "bytes")]
    if report.tail_bytes:
        rows.append(("unused at its end", f"{report.tail_bytes:,}", "bytes"))
    if report.version:
        rows.append(("version of the format", report.version, ""))
    for node in report.nodes:
        if node.is_stream:
            codec = node.codec.decode("ascii", "replace")
            rows.append((f"{node.name} ({codec})", f"{len(node.frames):,}", "frames"))
    if report.camera is not None:
        rows.append(("frame size", f"{report.camera.width}x{report.camera.height}", "pixels"))
        rows.append(("focal length", f"{report.camera.fx:.1f}", "pixels"))
        rows.append(("frame rate", f"{report.fps:g}", "frames/s"))
        rows.append(("duration", f"{report.duration_s:.2f}", "s"))
    rows.append(("readable depth frames", f"{report.readable_frames:,}", "frames"))
    print_table(rows, justify="lrl")
    for problem in report.problems[:MOST_PROBLEMS]:
        say(str(problem))
    if len(report.problems) > MOST_PROBLEMS:
        say(f"and {len(report.problems) - MOST_PROBLEMS} more problems")
    say(_verdict(report))


def _verdict(report: OniReport) -> str:
    if report.unsupported:
        return f"it is not damaged, but cannot be read: {report.unsupported}"
    if report.complete:
        decoded, frames = report.decoded_frames, report.readable_frames
        limit = "" if decoded == frames else f" (only {decoded} frames decoded; see --timeout)"
        return f"nothing is wrong with it{limit}"
    if report.openable:
        return f"it is incomplete, but readable to frame {report.readable_frames}"
    if not report.version:
        return "it is not an .oni recording"
    place = next(problem for problem in report.problems if not problem.harmless)
    before = sum(f.record_offset < place.offset for f in report.depth.frames) if report.depth else 0
    return f"it is damaged at byte {place.offset}; readable to frame {before}"
