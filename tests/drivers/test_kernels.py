"""Compiled kernels are kept where nobody else can put any, and a damaged one mends itself."""

from __future__ import annotations

import importlib.util
import logging
import os
import random
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba
import pytest

from selective_depth.drivers import kernels
from selective_depth.drivers.kernels import VARIABLE, njit, settle_cache

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions")


@pytest.fixture
def nothing_settled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, "")  # so that what is set meanwhile is taken back
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def refuse_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)


@pytest.mark.usefixtures("nothing_settled")
def test_where_numba_finds_a_place_nothing_is_changed() -> None:
    settle_cache()
    assert VARIABLE not in os.environ


@pytest.mark.usefixtures("nothing_settled")
def test_where_it_finds_none_it_gets_a_private_folder_and_the_same_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    refuse_writing(monkeypatch)
    settle_cache()
    folder = Path(os.environ.pop(VARIABLE))
    assert folder.parent == tmp_path
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    settle_cache()
    assert Path(os.environ[VARIABLE]) == folder


@pytest.mark.usefixtures("nothing_settled")
@pytest.mark.parametrize("trap", ["open to all", "link", "file"])
def test_a_folder_that_others_may_have_filled_is_not_used(
    trap: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    place = tmp_path / f"selective-depth-{os.getuid()}"
    if trap == "open to all":
        place.mkdir()
        place.chmod(0o777)
    elif trap == "link":
        place.symlink_to(tmp_path)
    else:
        place.touch()
    refuse_writing(monkeypatch)
    settle_cache()
    assert Path(os.environ[VARIABLE]) != place
    assert stat.S_IMODE(Path(os.environ[VARIABLE]).stat().st_mode) == 0o700


@pytest.mark.usefixtures("nothing_settled")
def test_what_the_user_says_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_writing(monkeypatch)
    monkeypatch.setenv(VARIABLE, "mine")
    settle_cache()
    assert os.environ[VARIABLE] == "mine"


KERNEL = """
from selective_depth.drivers.kernels import njit


@njit(cache=True, nogil=True)
def twice(n):
    return 2 * n + {extra}
"""


@pytest.fixture
def run_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> Callable[[], tuple[int, int, list[str]]]:
    """Import a kernel anew and run it: its result, how often it was compiled, what was said."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    module = tmp_path / "module.py"
    module.write_text(KERNEL.format(extra=1))

    def run() -> tuple[int, int, list[str]]:
        spec = importlib.util.spec_from_file_location("module", module)
        assert spec is not None and spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        kernels._say_once.cache_clear()
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            spec.loader.exec_module(loaded)
            result = loaded.twice(20)
        return result, sum(loaded.twice.stats.cache_misses.values()), caplog.messages

    return run


def emptied(data: bytes) -> bytes:
    return b""


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def overwritten(data: bytes) -> bytes:
    return random.Random(1).randbytes(len(data))


def flipped(data: bytes) -> bytes:
    """One bit, in what unpickling does not look at: the machine code, say."""
    middle = len(data) * 2 // 3
    return data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :]


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [emptied, cut, overwritten, flipped])
def test_a_damaged_kernel_is_compiled_anew_and_that_is_said_once(
    ending: str, damage: Callable[[bytes], bytes], run_twice: Callable[[], tuple[int, int, list[str]]], tmp_path: Path
) -> None:
    assert run_twice() == (41, 1, [])
    assert run_twice() == (41, 0, [])
    (file,) = tmp_path.rglob(f"*.{ending}")
    file.write_bytes(damage(file.read_bytes()))
    result, compiled, said = run_twice()
    assert (result, compiled) == (41, 1)
    assert len(said) == 1 and "is damaged; it is compiled anew" in said[0]
    assert run_twice() == (41, 0, [])


def test_fifty_random_damages_heal(run_twice: Callable[[], tuple[int, int, list[str]]], tmp_path: Path) -> None:
    draw = random.Random(2)
    for number in range(50):
        run_twice()
        file = draw.choice(sorted(path for path in tmp_path.rglob("*.nb[ic]")))
        data = bytearray(file.read_bytes())
        at = draw.randrange(len(data))
        way = draw.choice(("flip", "cut", "block", "longer"))
        if way == "flip":
            data[at] ^= 1 << draw.randrange(8)
        elif way == "cut":
            del data[at:]
        elif way == "block":
            data[at : at + 64] = draw.randbytes(64)
        else:
            data += draw.randbytes(64)
        file.write_bytes(data)
        result, compiled, said = run_twice()
        assert (result, compiled, len(said)) == (41, 1, 1), (number, way, at)
        assert run_twice() == (41, 0, []), (number, way, at)


def test_another_source_is_no_damage(run_twice: Callable[[], tuple[int, int, list[str]]], tmp_path: Path) -> None:
    run_twice()
    (tmp_path / "module.py").write_text(KERNEL.format(extra=200))
    assert run_twice() == (240, 1, [])


def test_where_a_kernel_cannot_be_kept_it_runs_and_that_is_said_once(
    run_twice: Callable[[], tuple[int, int, list[str]]], tmp_path: Path
) -> None:
    run_twice()
    for file in tmp_path.rglob("*.nbc"):
        file.unlink()
        file.mkdir()  # no file can take its place
    result, compiled, said = run_twice()
    assert (result, compiled) == (41, 1)
    assert len(said) == 1 and "cannot be kept" in said[0]


READ_ONLY = """
for folder in "$@"; do
    mount --bind "$folder" "$folder" && mount -o remount,bind,ro "$folder" || exit 99
done
"$PYTHON" -B -c "
from selective_depth.drivers.oni import codec
from selective_depth.selectors import improvement
print(codec._signed(5))"
"""


def test_nothing_writable_is_said_once_and_the_library_works(tmp_path: Path) -> None:
    unshare = shutil.which("unshare")
    own = [unshare or "", "--map-root-user", "--mount"]
    trial = [*own, "mount", "-t", "tmpfs", "none", str(tmp_path)]
    if unshare is None or subprocess.run(trial, capture_output=True, check=False).returncode:
        pytest.skip("no folder can be mounted here: that needs root, or Linux's user namespaces")
    root = Path(__file__).parents[2]
    # Also what a package that is installed finds writable; a folder inside another is no harm.
    writable = [root, Path.home(), Path(tempfile.gettempdir()), Path("/var/tmp"), Path("/dev/shm")]
    folders = [str(folder) for folder in dict.fromkeys(writable) if folder.is_dir()]
    environment = {**os.environ, "PYTHON": sys.executable}
    environment.pop(VARIABLE, None)
    done = subprocess.run(
        [*own, "sh", "-c", READ_ONLY, "sh", *folders],
        capture_output=True, text=True, timeout=60, check=False, env=environment, cwd=root,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "5\n"), done.stderr
    assert done.stderr.count("\n") == 1
    assert "Compiled kernels cannot be kept here" in done.stderr


def test_the_share_of_kernels_that_are_kept_tells_a_first_run(tmp_path: Path) -> None:
    """By processes with a cache folder of their own: empty at first, then with what the first has compiled."""
    script = (
        "from selective_depth.drivers import kernels\n"
        "from selective_depth.selectors import choice, samples\n"
        "print(kernels.kept_share())\n"
        "import numpy as np\n"
        "choice.choose(np.ones((40, 40), np.float32), 3)\n"
        "print(kernels.kept_share())\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
    ).stdout.split()
    assert float(done[0]) == 0 < float(done[1])


def test_an_inner_kernel_is_called_by_kernels_only() -> None:
    @njit(inner=True)
    def half(number):
        return number / 2

    @njit()
    def quarter(number):
        return half(half(number))

    assert quarter(3.0) == half.py_func(1.5) == 0.75
    with pytest.raises(TypeError, match="'half' is compiled for other kernels"):
        half(3.0)


def test_without_a_compiler_an_inner_kernel_is_a_function() -> None:
    code = "from selective_depth.drivers.kernels import njit; print(njit(inner=True)(lambda x: 2 * x)(-1))"
    run = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, capture_output=True
    )
    assert run.stdout.strip() == b"-2", run.stderr
