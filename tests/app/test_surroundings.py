"""Where it runs: another user's account with an install that cannot be written, and a Jupyter kernel."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from jupyter_client.manager import KernelManager
from virtual_sensor import VirtualSensor

from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.open import open_source

RUN = ("replay", "virtual:ball?size=160x120&frames=3", "--headless", "--seeds.rows", "24", "--seeds.columns", "32")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="only root can become another user")
def test_another_users_account_with_an_install_it_cannot_write(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    os.chown(home, 65534, 65534)
    # Read anything, write nothing but its own: Python itself may lie in root's home.
    reads = ("--inh-caps", "+dac_read_search", "--ambient-caps", "+dac_read_search")
    become = [shutil.which("setpriv") or "setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups", *reads]
    for folder in (*tmp_path.parents, tmp_path):
        if folder.stat().st_uid == 0 and str(folder).startswith("/tmp/"):
            folder.chmod(0o755)
    env = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    env |= {"HOME": str(home), "PATH": os.environ["PATH"]}
    command = [*become, sys.executable, "-m", "selective_depth.app", *RUN, "--save", str(home / "x.rrd")]
    first = subprocess.run(command, env=env, cwd=home, capture_output=True, text=True, timeout=300)
    assert first.returncode == 0, first.stderr
    assert (home / "x.rrd").stat().st_uid == 65534
    refused = subprocess.run(
        [*command[:-1], str(tmp_path / "not-mine.rrd")], env=env, cwd=home, capture_output=True, text=True, timeout=300
    )
    assert refused.returncode == 1 and "cannot be written" in refused.stderr and "Traceback" not in refused.stderr


def in_kernel(client: object, code: str, timeout_s: float = 120) -> str:
    """Run a cell; what it printed, or the error that ended it."""
    said: list[str] = []

    def hear(message: dict[str, object]) -> None:
        content = message["content"]
        assert isinstance(content, dict)
        said.append(str(content.get("text") or f"{content.get('ename', '')} {content.get('evalue', '')}".strip()))

    reply = client.execute_interactive(code, timeout=timeout_s, output_hook=hear)  # type: ignore[attr-defined]
    status = reply["content"]["status"]
    return "".join(said) if status == "ok" else f"{status}: {reply['content'].get('ename')}"


@pytest.mark.slow
@pytest.mark.openni
def test_in_a_jupyter_kernel(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    manager = KernelManager()
    manager.start_kernel(env=os.environ | virtual_sensor.env, cwd=str(tmp_path))
    client = manager.client()
    client.start_channels()
    try:
        client.wait_for_ready(timeout=60)
        library = (
            "from selective_depth.drivers import open_source\n"
            "from selective_depth.selectors.acquire import acquire\n"
            "from selective_depth.selectors.seeds import SeedGrid\n"
            "frame = open_source('virtual:ball?size=160x120').read()\n"
            "model = acquire(frame.measure, SeedGrid.from_frame(frame, (24, 32)), 0.05, 4)\n"
            "print(model.reconstruct().shape)"
        )
        assert in_kernel(client, library).strip() == "(120, 160)"
        live = "with open_source('openni') as device:\n    print(*(device.read().index >= 0 for _ in range(5)))"
        assert in_kernel(client, live).strip() == "True True True True True"
        command = f"from selective_depth.app.cli import run\nprint(run({list(RUN)!r}))"
        assert in_kernel(client, command).rstrip().endswith("0")
        # Interrupted in the middle of a read, it is a KeyboardInterrupt, and the next cell works.
        client.execute("device = open_source('openni')\nwhile True:\n    device.read()")
        client.get_iopub_msg(timeout=10)
        manager.interrupt_kernel()
        assert client.get_shell_msg(timeout=20)["content"]["ename"] == "KeyboardInterrupt"
        assert in_kernel(client, "device.close()\nprint('closed')").strip() == "closed"
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)


def test_few_descriptors_end_in_a_sentence(tmp_path: Path) -> None:
    script = f"ulimit -n 12; exec {sys.executable} -m selective_depth.app {' '.join(map(repr, RUN))} --save x.rrd"
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "too many files are open at once" in done.stderr and "ulimit -n" in done.stderr


@pytest.mark.parametrize("name", ["a" * 5000, "x\0y", "a" * 300 + ".oni"])
def test_a_name_that_no_file_can_have_is_a_named_error(name: str) -> None:
    with pytest.raises(SourceNotFoundError, match=r"cannot be the name of a file|does not exist"):
        open_source(name)
