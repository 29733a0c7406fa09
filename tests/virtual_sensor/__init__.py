"""A depth sensor in software, behind the real OpenNI2 runtime, for tests and recordings.

`VirtualSensor` makes a private runtime folder that holds the system's OpenNI2 library, its
`.oni` reader and the driver of `driver.cpp`; a process whose environment has `sensor.env` sees
that sensor and no other. `sensor.set(...)` changes it while it runs:

=================  ========  ==================================================================
key                default   meaning
=================  ========  ==================================================================
connected          1         0: pulled out
devices            1         2: a second sensor beside the first
width, height      640, 480  size of its largest mode (a mode of half that size is on at first)
fps                30        frames each second
burst              1         frames made back to back, then a pause: the same rate, unevenly
limit              -1        stop after this many frames of a stream (a stall); -1: never
stall              0         1: no frames, and no error either
odd                0         1: frames of half the height
no_fov             0         1: it does not know its field of view
degrees            0         1: it states its field of view in degrees
other_fov          0         1: it states that of another camera
tenths             0         1: its unit is 0.1 mm
pad                0         bytes between the rows of a frame
empty              0         1: transfers that carry nothing
first_ms           50        how long its first frame takes
unreadable         0         1: properties that it says it has cannot be read
clock              0         its times: 1: always 0; 2: in ms; 3: 32 bits of 60 MHz, full after 1 s;
                             4: every fourth lies before the one before
aborts             0         1: the driver aborts when it is pulled out
serial0, serial1             serial numbers of the sensors
addresses          0         1: all are addresses of the first
refuse_open,       0         1: that call fails
refuse_stream,
refuse_start
hang_open,         0         1: that call never returns
hang_start,
hang_stop
crash              0         1: segmentation fault in the driver
frames             none      file of raw uint16 images, played round and round
colour             none      file of raw colour images, in step with them
colour_width,      as depth  size of its largest mode
colour_height
colour_format      200       OpenNI2's number of its pixel format (RGB888)
colour_first_ms    50        how long its first image takes
colour_late_us     0         how much later than depth it is stamped
stall_colour       0         1: no colour images, and no error either
odd_colour         0         1: colour images of half the height
refuse_colour,     0         1: that call fails
refuse_colour_start
registers          0         1: the sensor can register depth to colour
=================  ========  ==================================================================
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

HERE = Path(__file__).parent
SOURCE = HERE / "driver.cpp"
HEADERS = Path("/usr/include/openni2")


class RigMissingError(RuntimeError):
    """The virtual sensor cannot be built here; the message says what to install."""


def _system_library() -> Path:
    for folder in (*Path("/usr/lib").glob("*-linux-gnu*"), Path("/usr/lib"), Path("/usr/lib64")):
        if (folder / "libOpenNI2.so.0").is_file():
            return folder / "libOpenNI2.so.0"
    raise RigMissingError("there is no libOpenNI2.so.0: apt install libopenni2-0")


def build_driver() -> Path:
    """Compile `driver.cpp`, once for each version of it, and return the library's path."""
    compiler = shutil.which("g++")
    if compiler is None or not HEADERS.is_dir():
        raise RigMissingError("the virtual sensor needs: apt install g++ libopenni2-dev")
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    library = HERE / "build" / f"libVirtualSensor-{digest}.so"
    if not library.exists():
        library.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            made = Path(folder) / "driver.so"
            flags = ["-shared", "-fPIC", "-O2", "-std=c++17", "-Wall", "-Wextra", "-Werror"]
            subprocess.run([compiler, *flags, f"-I{HEADERS}", str(SOURCE), "-o", str(made), "-pthread"], check=True)
            made.replace(library)
    return library


class VirtualSensor:
    """One private OpenNI2 runtime with a virtual sensor attached.

    Parameters
    ----------
    folder : Path
        An empty folder to make it in.
    frames : uint16 array of shape (n, height, width), optional
        What the sensor sees, played round and round; default all zero.
    colour : uint8 array of shape (n, height, width, 3), optional
        What its colour camera sees; default it has none.
    **keys
        First settings, as for `set`.
    """

    def __init__(
        self,
        folder: Path,
        frames: npt.NDArray[np.uint16] | None = None,
        colour: npt.NDArray[np.uint8] | None = None,
        **keys: int,
    ) -> None:
        library = _system_library()
        self.runtime = folder / "runtime"
        drivers = self.runtime / "OpenNI2" / "Drivers"
        drivers.mkdir(parents=True)
        (self.runtime / "libOpenNI2.so").symlink_to(library)
        (drivers / "libOniFile.so.0").symlink_to(library.parent / "OpenNI2" / "Drivers" / "libOniFile.so.0")
        (drivers / "libVirtualSensor.so.0").symlink_to(build_driver())
        self._control = folder / "control.txt"
        self._keys: dict[str, int | Path] = {"connected": 1}
        if frames is not None:
            file = folder / "frames.raw"
            frames.astype(np.uint16).tofile(file)
            self._keys |= {"frames": file, "height": frames.shape[1], "width": frames.shape[2]}
        if colour is not None:
            (folder / "colour.raw").write_bytes(colour.tobytes())
            self._keys["colour"] = folder / "colour.raw"
        self.set(**keys)

    @property
    def env(self) -> dict[str, str]:
        """What a process needs in its environment to see this sensor."""
        return {"OPENNI2_REDIST": str(self.runtime), "VIRTUAL_SENSOR_CONTROL": str(self._control)}

    def set(self, **keys: int | Path) -> None:
        """Change the sensor, now; it takes effect within a few milliseconds."""
        self._keys |= keys
        lines = "".join(f"{key}={value}\n" for key, value in self._keys.items())
        fresh = self._control.with_suffix(".new")
        fresh.write_text(lines)
        fresh.replace(self._control)  # never half a file


def record_oni(frames: npt.NDArray[np.uint16], out: Path, *, fps: int = 60, overwrite: bool = True) -> None:
    """Make an `.oni` that holds exactly these frames, through the real OpenNI2 recorder.

    Parameters
    ----------
    frames : uint16 array of shape (n, height, width)
        Depth in millimetres, below 10,000 (what the codec keeps without loss).
    out : Path
        The recording to make.
    fps : int, default 60
        How fast to record; the recording's own clock says 30 frames a second all the same.
    overwrite : bool, default True
        Whether an older file of that name is replaced.
    """
    from selective_depth.drivers.oni import inspect_oni
    from selective_depth.drivers.openni.runtime import find_runtime

    if frames.max(initial=0) >= 10_000:
        raise ValueError(f"depth reaches {frames.max()} mm; the codec keeps values below 10000")
    if out.exists():
        if not overwrite:
            raise FileExistsError(out)
        out.unlink()
    count, height, width = frames.shape
    script = Path(__file__).parent.parent / "openni2_recorder.py"
    with tempfile.TemporaryDirectory() as folder:
        sensor = VirtualSensor(Path(folder), frames, fps=fps, limit=count)
        library = str(sensor.runtime / find_runtime().path.name)
        words = [sys.executable, str(script), library, str(out), *map(str, (count, width, height))]
        subprocess.run(words, env=os.environ | sensor.env, check=True, timeout=60 + count / fps)
    report = inspect_oni(out, decode=True)
    os.truncate(out, report.size_bytes - report.tail_bytes)
    if report.readable_frames != count:
        raise RuntimeError(f"{out} has {report.readable_frames} of {count} frames.")
