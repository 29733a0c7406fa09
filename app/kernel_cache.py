"""Where compiled kernels are kept if Numba finds no place of its own."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def settle_cache() -> None:
    """Name a folder of our own where neither the code's nor the user's cache can be written.

    There Numba, which reads the variable when it is imported, would not run at all: in a container
    under some user's number, say, with the package installed by another.
    """
    if VARIABLE in os.environ:
        return
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 - Path's raises where there is no home
    if not _writable(Path(__file__).parent / "__pycache__") and not _writable(Path(caches)):
        os.environ[VARIABLE] = str(_own_folder())


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which may have to be made first."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK)


def _own_folder() -> Path:
    """A folder in which nobody else can have put anything: what is in there is run."""
    if os.name == "posix":
        folder = Path(tempfile.gettempdir(), f"selective-depth-{os.getuid()}")
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            about = folder.lstat()
            ours = stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid()
        except OSError:
            ours = False
        if ours and not about.st_mode & 0o077:
            return folder
    return Path(tempfile.mkdtemp(prefix="selective-depth-"))
