"""Compiled kernels are kept where nobody else can put any."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

import pytest

from selective_depth.app import kernel_cache
from selective_depth.app.kernel_cache import VARIABLE, settle_cache

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions")


@pytest.fixture(autouse=True)
def nothing_settled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, "")  # so that what is set meanwhile is taken back
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def refuse_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)


def test_where_numba_finds_a_place_nothing_is_changed() -> None:
    settle_cache()
    assert VARIABLE not in os.environ


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


def test_what_the_user_says_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_writing(monkeypatch)
    monkeypatch.setenv(VARIABLE, "mine")
    settle_cache()
    assert os.environ[VARIABLE] == "mine"
    assert kernel_cache.VARIABLE == "NUMBA_CACHE_DIR"
