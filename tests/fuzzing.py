"""Damaged inputs for every reader: ``python tests/fuzzing.py [TARGET...] --minutes 20`` looks for what none survives.

A target is a handful of small sound inputs and a way to read them. Inputs are damaged at random,
blindly and with an eye to their form (numbers in headers and texts, checksums put right again). A
finding is whatever is no named error: a crash, an exception of another kind, more than `HANG_S`
of computing or `MEMORY_BYTES` of memory, or a word on standard error. Each target runs in a process of
its own, and what it found is kept in ``out/fuzz``.
"""

from __future__ import annotations

import argparse
import io
import os
import random
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

HANG_S = 5
MEMORY_BYTES = 6 << 30
FRAMES = 4
FOUND = 86
"""Exit code of a process that has found something."""
_NUMBERS = (
    0,
    1,
    2,
    3,
    27,
    0x7F,
    0xFF,
    0x7FFF,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFE,
    0xFFFFFFFF,
    1 << 62,
    (1 << 64) - 1,
)
_WORDS = (
    *("0", "-1", "1", "65536", "2147483647", "4294967296", "99999999999999999999", "1e300", "-1e-300", "nan", "inf"),
    *("", "../../x", "/dev/zero", "é", "\0", "a" * 5000, "true", "[]", "{}", '"', "[" * 500, "2020-01-01", "0x10"),
)

Files = dict[str, bytes]


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Parameters
    ----------
    make : callable
        Makes the sound inputs, as files by name; the first name is what is opened.
    read : callable
        Reads what lies in a folder, and raises.
    """

    make: Callable[[], list[Files]]
    read: Callable[[Path], None]


def _open(path: Path, query: str = "") -> None:
    from selective_depth.drivers import open_source

    with open_source(f"{path}{query}") as source:
        for _, frame in zip(range(FRAMES), source, strict=False):
            assert frame.depth_mm.shape == frame.shape and frame.depth_mm.dtype == np.uint16
            assert frame.colour is None or frame.colour.dtype == np.uint8


def _settings(folder: Path) -> None:
    from selective_depth.app import cli  # noqa: F401 - declares the commands
    from selective_depth.app.console.command import find, parse_with_settings

    parse_with_settings(find("replay"), ["x"], folder / "settings.toml", None)


def _frames(count: int, size: tuple[int, int] = (12, 16)) -> list[np.ndarray]:
    draw = np.random.default_rng(1)
    return [draw.integers(400, 4000, size).astype(np.uint16) for _ in range(count)]


def _png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


def _written(write: Callable[[Path], object]) -> Files:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        return {
            str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
        }


def _oni_inputs() -> list[Files]:
    from selective_depth.drivers.frame import Camera, DepthFrame
    from selective_depth.drivers.oni import write_oni

    made = []
    for colour in (None, np.zeros((12, 16, 3), np.uint8)):
        frames = [
            DepthFrame(
                image, k, 33_333 * k, Camera(16, 12, 15.0, 15.0, 7.5, 5.5), colour=colour, registered=colour is not None
            )
            for k, image in enumerate(_frames(3))
        ]
        made.append(_written(lambda folder, frames=frames: write_oni(folder / "x.oni", frames)))  # type: ignore[misc]
    return made


def _folder_inputs() -> list[Files]:
    from selective_depth.drivers.folder import write_folder
    from selective_depth.drivers.frame import Camera, DepthFrame

    camera = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)
    frames = [
        DepthFrame(image, k, 33_333 * k, camera, colour=np.zeros((12, 16, 3), np.uint8) + k, registered=True)
        for k, image in enumerate(_frames(2))
    ]
    plain = _written(lambda folder: write_folder(folder, frames))
    images = {f"depth/{k}.png": _png(image) for k, image in enumerate(_frames(2))}
    beside = [
        {"scene_camera.json": b'{"0": {"cam_K": [15, 0, 8, 0, 15, 6, 0, 0, 1], "depth_scale": 1.0}}'},
        {"camera_intrinsic.json": b'{"width": 16, "height": 12, "intrinsic_matrix": [15, 0, 0, 0, 15, 0, 8, 6, 1]}'},
        {"intrinsic/intrinsic_depth.txt": b"15 0 8 0\n0 15 6 0\n0 0 1 0\n0 0 0 1\n"},
        {"calibration.txt": b"15 15 8 6", "depth.txt": b"0.1 depth/0.png\n0.2 depth/1.png\n"},
        {
            "intrinsics.txt": b"15 0 8\n0 15 6\n0 0 1\n",
            "image/0.jpg": bytes(cv2.imencode(".jpg", np.zeros((12, 16, 3), np.uint8))[1]),
        },
    ]
    pgm = {"depth/0.pgm": b"P5 16 12 65535\n" + _frames(1)[0].astype(">u2").tobytes()}
    tiff = {"depth/0.tiff": bytes(cv2.imencode(".tiff", _frames(1)[0])[1])}
    return [plain, *({**images, **more} for more in beside), pgm, tiff]


def _tum_inputs() -> list[Files]:
    images = {f"depth/{k}.png": _png(image) for k, image in enumerate(_frames(2))}
    colours = {f"rgb/{k}.png": _png(np.zeros((12, 16, 3), np.uint8)) for k in range(2)}
    lists: list[Files] = [
        {
            "depth.txt": b"# depth\n1.5 depth/0.png\n1.6 depth/1.png\n",
            "rgb.txt": b"# rgb\n1.51 rgb/0.png\n1.61 rgb/1.png\n",
        },
        {"associations.txt": b"1.5 depth/0.png 1.51 rgb/0.png\n1.6 depth/1.png 1.62 rgb/1.png\n"},
    ]
    return [{**each, **images, **colours} for each in lists]


def _ply_inputs() -> list[Files]:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat {{}} 1.0\nelement vertex 4\n{axes}element face 2\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    corners = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    text = "".join(f"{x} {y} {z}\n" for x, y, z in corners) + "3 0 1 2\n3 0 1 3\n"
    made = [{"x.ply": (header.format("ascii") + text).encode()}]
    for order, name in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        body = b"".join(struct.pack(f"{order}3f", *each) for each in corners)
        body += b"".join(struct.pack(f"{order}B3i", 3, *each) for each in ((0, 1, 2), (0, 1, 3)))
        made.append({"x.ply": header.format(name).encode() + body})
    return made


def _array_inputs() -> list[Files]:
    made = []
    for array in (np.stack(_frames(2)), _frames(1)[0].astype(np.float32) / 1000):
        plain, packed = io.BytesIO(), io.BytesIO()
        np.save(plain, array)
        np.savez_compressed(packed, depth=array)
        made += [{"x.npy": plain.getvalue()}, {"x.npz": packed.getvalue()}]
    return made


def _settings_inputs() -> list[Files]:
    from selective_depth.app.console.settings_file import to_toml
    from selective_depth.app.settings import Settings

    return [{"settings.toml": to_toml(Settings(), "made by a test").encode()}]


TARGETS = {
    "oni": Target(_oni_inputs, lambda folder: _open(folder / "x.oni")),
    "folder": Target(_folder_inputs, lambda folder: _open(folder, "?scale=1000")),
    "tum": Target(_tum_inputs, lambda folder: _open(folder, "?scale=5000")),
    "ply": Target(_ply_inputs, lambda folder: _open(next(folder.iterdir()), "?size=32x24")),
    "arrays": Target(_array_inputs, lambda folder: _open(next(folder.iterdir()), "?scale=1000")),
    "settings": Target(_settings_inputs, _settings),
}


def _flip(data: bytearray, draw: random.Random) -> None:
    for _ in range(draw.choice((1, 1, 2, 8))):
        data[draw.randrange(len(data))] ^= draw.randrange(1, 256)


def _set_number(data: bytearray, draw: random.Random) -> None:
    size = draw.choice((1, 2, 4, 4, 8))
    at = draw.randrange(max(1, min(len(data), draw.choice((64, 1500, 1 << 20))) - size + 1))
    value = draw.choice((*_NUMBERS, draw.getrandbits(64))) % (1 << 8 * size)
    data[at : at + size] = value.to_bytes(size, draw.choice(("little", "big")))


def _move_block(data: bytearray, draw: random.Random) -> None:
    start = draw.randrange(len(data))
    end = min(len(data), start + draw.choice((1, 4, 28, 512)))
    way, block = draw.randrange(4), bytes(data[start:end])
    if way == 0:
        del data[start:end]
    elif way == 1:
        data[start:start] = block * draw.choice((1, 3, 100))
    elif way == 2:
        data[start:end] = bytes(end - start)
    else:
        del data[start:]


def _change_word(data: bytearray, draw: random.Random) -> None:
    """Change a number or a word of what reads as text, up to the first byte that does not."""
    text = re.match(rb"[\t\n\r\x20-\x7e]*", bytes(data))
    words = list(re.finditer(rb"[-+.\w]+", text[0] if text else b""))
    if words:
        word = draw.choice(words)
        other = draw.choice(words)[0] if draw.random() < 0.3 else draw.choice(_WORDS).encode()
        data[word.start() : word.end()] = other


def _change_line(data: bytearray, draw: random.Random) -> None:
    lines = bytes(data).split(b"\n")
    at = draw.randrange(len(lines))
    way = draw.randrange(3)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(at, draw.choice(lines))
    else:
        other = draw.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    data[:] = b"\n".join(lines)


def _right_again(name: str, data: bytearray) -> None:
    """Put the checksums of a PNG file right, as far as its chunks can be followed."""
    at = 8
    while name.endswith(".png") and at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data):
            return
        data[end : end + 4] = zlib.crc32(data[at + 4 : end]).to_bytes(4, "big")
        at = end + 4


def _inside_zip(data: bytes, draw: random.Random) -> bytes:
    """Damage what an archive holds, and pack it again."""
    packed = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as out:
            for name in archive.namelist():
                inner = bytearray(archive.read(name))
                draw.choice(_WAYS)(inner, draw)
                out.writestr(name, bytes(inner))
    except (zipfile.BadZipFile, zlib.error, ValueError, RuntimeError, EOFError, OSError):
        return data  # damaged from without already
    return packed.getvalue()


_WAYS = (_flip, _set_number, _set_number, _move_block, _change_word, _change_word, _change_line)


def damaged(inputs: list[Files], seed: int) -> Files:
    """One input, damaged in one to three ways; the same for the same seed."""
    draw = random.Random(seed)
    files = dict(draw.choice(inputs))
    for _ in range(draw.choice((1, 1, 2, 3))):
        texts = [name for name in files if not name.endswith((".png", ".jpg"))]
        name = draw.choice(texts if texts and draw.random() < 0.7 else list(files))
        if draw.random() < 0.02 and len(files) > 1:
            del files[name]
            continue
        if name.endswith(".npz") and draw.random() < 0.6:
            files[name] = _inside_zip(files[name], draw)
            continue
        data = bytearray(files[name])
        if data:
            draw.choice(_WAYS)(data, draw)
        if draw.random() < 0.7:
            _right_again(name, data)
        files[name] = bytes(data)
    return files


def try_one(target: Target, files: Files, folder: Path) -> str:
    """What becomes of an input: the kind of named error, or ``read``; anything else is raised."""
    from selective_depth.app.console.errors import AppError
    from selective_depth.drivers.errors import SourceError

    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    try:
        target.read(folder)
    except (SourceError, AppError) as error:
        assert str(error).strip() and "\n" not in str(error), f"no sentence: {error!r}"
        return type(error).__name__
    return "read"


def seeds_tried(name: str, first: int, until_s: float) -> Iterator[tuple[int, str, bool]]:
    """Try one input after the other: its seed, what became of it, whether a library may print: libtiff does."""
    target = TARGETS[name]
    inputs, seed = target.make(), first
    for files in inputs:
        with tempfile.TemporaryDirectory() as folder:
            assert try_one(target, files, Path(folder)) == "read", f"{list(files)} is not read undamaged"
    while time.monotonic() < until_s:
        with tempfile.TemporaryDirectory() as folder:
            signal.setitimer(signal.ITIMER_PROF, HANG_S)
            files = damaged(inputs, seed)
            yield seed, try_one(target, files, Path(folder)), any(name.endswith(".tiff") for name in files)
            signal.setitimer(signal.ITIMER_PROF, 0)
        seed += 1


def _work(name: str, first: int, minutes: float, note: Path) -> int:
    """Fuzz in this process, noting before each input which it is."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))

    def late(*_: object) -> None:
        raise TimeoutError(f"an input computes for more than {HANG_S} s")

    signal.signal(signal.SIGPROF, late)
    counts: Counter[str] = Counter()
    seed = first
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
    try:
        for seed, outcome, may_print in seeds_tried(name, first, time.monotonic() + 60 * minutes):
            counts[outcome] += 1
            note.write_text(str(seed + 1))
            lines = os.pread(2, 1000, 0).decode(errors="replace").splitlines()
            os.ftruncate(2, os.lseek(2, 0, os.SEEK_SET))
            if lines and not may_print:
                raise AssertionError(f"it prints on standard error: {lines}")
    except BaseException:  # noqa: BLE001 - whatever it is, it is what is looked for
        print(f"{name}: finding with seed {note.read_text() if note.exists() else seed}")
        traceback.print_exc(limit=-4, file=sys.stdout)
        return FOUND
    finally:
        print(f"{name}: {sum(counts.values()):,} inputs from seed {first}: {dict(counts)}", flush=True)
    return 0


def main() -> int:
    """Run targets side by side, each in a process that may crash."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", default=list(TARGETS))
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    out = Path("out", "fuzz")
    out.mkdir(parents=True, exist_ok=True)
    for name in asked.targets:
        (out / f"{name}.seed").write_text(str(asked.first))
    if asked.work:
        return _work(asked.targets[0], asked.first, asked.minutes, out / f"{asked.targets[0]}.seed")
    command = [sys.executable, __file__, "--work", "--minutes", str(asked.minutes), "--first", str(asked.first)]
    running = {name: subprocess.Popen([*command, name]) for name in asked.targets}
    failed = 0
    for name, process in running.items():
        try:
            code = process.wait(60 * asked.minutes + 120)
        except subprocess.TimeoutExpired:
            process.kill()
            code = -signal.SIGKILL
        if code:
            failed = 1
            seed = (out / f"{name}.seed").read_text()
            print(f"{name}: ended with {code}; see seed {seed}: python tests/fuzzing.py {name} --first {seed}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
