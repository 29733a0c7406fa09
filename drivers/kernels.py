"""Compiled functions that are kept on disk, and that run whatever has become of that disk.

Numba's own cache ends every run on a file in it that is damaged, and every import where no folder
can be written. Here such a function is compiled anew, and that is said once.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import multiprocessing
import os
import pickle
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

VARIABLE = "NUMBA_CACHE_DIR"
_DIGEST = hashlib.sha256().digest_size

log = logging.getLogger(__name__)


def settle_cache() -> None:
    """Name a folder of our own where neither the code's nor the user's cache can be written.

    In a container under some user's number, say, with the package installed by another. Numba
    reads the variable when it is imported.
    """
    if VARIABLE in os.environ:
        return
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 - Path's raises where there is no home
    if not _writable(Path(__file__).parent / "__pycache__") and not _writable(Path(caches)):
        with suppress(OSError):  # nothing is writable: every kernel says so for itself
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
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            about = folder.lstat()
            if stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not about.st_mode & 0o077:
                return folder
    return Path(tempfile.mkdtemp(prefix="selective-depth-"))


settle_cache()

from numba import njit as compiled  # noqa: E402 - after the folder is settled
from numba.core.caching import FunctionCache, IndexDataCacheFile  # noqa: E402
from numba.core.registry import CPUDispatcher  # noqa: E402


class _Inner(CPUDispatcher):
    def __call__(self, *_: object, **__: object) -> NoReturn:
        raise TypeError(
            f"'{self.py_func.__name__}' is compiled for other kernels to call; from Python, take its py_func."
        )


def njit(*, cache: bool = False, inner: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Numba's `njit`, but for a cache that mends itself.

    Parameters
    ----------
    cache : bool, default False
        Keep what is compiled on disk, for the next run.
    inner : bool, default False
        Only other kernels call it. What Python needs to call one takes a twentieth of a second to
        compile, and of one that takes tuples of arrays several times as long.
    **options
        As for `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        # No kernel is called from C: a wrapper for that is a twelfth of the time to compile. Nor does
        # one look for divisions by zero, which keep loops from being vectorised.
        options.update(no_cfunc_wrapper=True, no_cpython_wrapper=inner, error_model="numpy")
        dispatcher: Any = compiled(**options)(function)
        if inner and isinstance(dispatcher, CPUDispatcher):  # without the wrapper, a call would end the process
            dispatcher.__class__ = _Inner
        try:
            if cache:
                dispatcher._cache = _MendingCache(function)
        except RuntimeError:  # Numba found no folder that can be written
            _say_once(
                "Compiled kernels cannot be kept here, so every start takes its time: no folder for"
                f" them can be written. Name one in the environment: {VARIABLE}=FOLDER."
            )
        return dispatcher

    return decorate


class _CheckedFile(IndexDataCacheFile):
    """The files of a function's cache, each with a digest at its end.

    Not every damage is noticed by unpickling: other machine code would be run.
    """

    def _dump(self, obj: object) -> bytes:
        data: bytes = super()._dump(obj)
        return data + hashlib.sha256(data).digest()

    def _load_index(self) -> Any:
        with suppress(FileNotFoundError), Path(self._index_path).open("rb") as file:
            pickle.load(file)  # Numba's version
            _checked(file.read())
        return super()._load_index()

    def _load_data(self, name: str) -> Any:
        return pickle.loads(_checked(Path(self._data_path(name)).read_bytes()))


def _checked(data: bytes) -> bytes:
    """What was written, without its digest, or ValueError."""
    if hashlib.sha256(data[:-_DIGEST]).digest() != data[-_DIGEST:]:
        raise ValueError("damaged")
    return data[:-_DIGEST]


class _MendingCache(FunctionCache):
    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _CheckedFile(
            cache_path=self._cache_path,
            filename_base=f"{self._impl.filename_base}.checked",
            source_stamp=self._impl.locator.get_source_stamp(),
        )

        _CACHES.append(self)

    @property
    def filled(self) -> bool:
        """Whether anything is in it, whole or not."""
        return Path(self._cache_file._index_path).exists()

    def load_overload(self, sig: object, target_context: object) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001 - a damaged pickle can raise anything
            _say_once(f"A compiled kernel in '{self.cache_path}' is damaged; it is compiled anew.")
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: object, data: object) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as error:  # noqa: BLE001 - an index that could not be flushed, a full disk
            _say_once(f"Compiled kernels cannot be kept in '{self.cache_path}': {error}.")


_CACHES: list[_MendingCache] = []


def kept_share() -> float:
    """Share of the kernels declared so far that some earlier run has compiled and kept."""
    return sum(cache.filled for cache in _CACHES) / len(_CACHES) if _CACHES else 1.0


@functools.cache
def _say_once(sentence: str) -> None:
    if multiprocessing.parent_process() is None:  # which has said it
        log.warning("%s", sentence)
