"""Where the OpenNI2 runtime is installed."""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass
from pathlib import Path

from selective_depth.drivers.errors import RuntimeMissingError

_INSTALL = {
    "linux": "Install it with `sudo apt install libopenni2-0` (other systems: their package named"
    " openni2), or set OPENNI2_REDIST to the folder that holds libOpenNI2.so.",
    "darwin": "Install it with `brew install openni2`, or set OPENNI2_REDIST to the folder that"
    " holds libOpenNI2.dylib.",
    "win32": "Install the OpenNI 2.2 SDK (for a Kinect, the Microsoft Kinect SDK 1.8 as well), or"
    " set OPENNI2_REDIST64 to the folder that holds OpenNI2.dll.",
}
_LIBRARY_NAMES = {
    # Debian's runtime package alone has only the second name.
    "linux": ("libOpenNI2.so", "libOpenNI2.so.0"),
    "darwin": ("libOpenNI2.dylib",),
    "win32": ("OpenNI2.dll",),
}


@dataclass(frozen=True, slots=True)
class Runtime:
    """An OpenNI2 runtime on this computer.

    Parameters
    ----------
    path : Path
        The shared library; its drivers are in ``OpenNI2/Drivers`` beside it.
    """

    path: Path

    @property
    def folder(self) -> Path:
        """Where its drivers are."""
        return self.path.parent / "OpenNI2" / "Drivers"

    @property
    def pattern(self) -> str:
        """Names of the files that it loads; Debian's differs from what drivers are built as."""
        if sys.platform != "linux":
            return "*.dll" if sys.platform == "win32" else "lib*.dylib"
        debian = self.path.resolve().suffix == ".0" or any(self.folder.glob("lib*.so.0"))
        return "lib*.so.0" if debian else "lib*.so"

    @property
    def not_loaded(self) -> tuple[str, ...]:
        """Files beside its drivers that look like drivers but have a name that it does not load."""
        files = sorted(self.folder.glob("*.so*"))
        return tuple(str(file) for file in files if not file.match(self.pattern))

    @property
    def drivers(self) -> tuple[str, ...]:
        """Names of the sensor drivers it will load, without prefix and suffix."""
        files = self.folder.glob(self.pattern)
        plain = {file.name.partition(".")[0].removeprefix("lib") for file in files}
        return tuple(sorted(plain - {"OniFile", ""}))


def find_runtime() -> Runtime:
    """Find the OpenNI2 runtime: where OPENNI2_REDIST points, else in the system's usual folders.

    Raises
    ------
    RuntimeMissingError
        Saying where it was looked for and how to install it.
    """
    system = sys.platform if sys.platform in _INSTALL else "linux"
    variable = "OPENNI2_REDIST64" if os.environ.get("OPENNI2_REDIST64") else "OPENNI2_REDIST"
    chosen = os.environ.get(variable)
    # Whoever names a folder means it: another runtime must not be used silently instead.
    folders = [Path(chosen)] if chosen else _usual_folders(system)
    for folder in folders:
        for name in _LIBRARY_NAMES[system]:
            if (folder / name).is_file():
                return Runtime((folder / name).absolute())
    where = f"{variable} names {chosen}" if chosen else f"looked in {', '.join(map(str, folders))}"
    raise RuntimeMissingError(
        f"The OpenNI2 runtime ({_LIBRARY_NAMES[system][-1]}) was not found: {where}. {_INSTALL[system]}"
    )


def _usual_folders(system: str) -> list[Path]:
    if system == "win32":
        roots = [os.environ.get(name) for name in ("ProgramFiles", "ProgramFiles(x86)")]
        return [Path(root) / "OpenNI2" / "Redist" for root in roots if root]
    if system == "darwin":
        return [Path(root, "lib", sub) for root in ("/opt/homebrew", "/usr/local") for sub in ("ni2", "")]
    multiarch = f"{platform.machine()}-linux-gnu"
    return [Path(root, sub) for root in ("/usr/local", "/usr") for sub in (f"lib/{multiarch}", "lib", "lib64")]
