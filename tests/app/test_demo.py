"""The demo page: who may use it, what can be reached from it; its look and its feel are in `test_demo_browser`."""

from __future__ import annotations

import asyncio
import http.client
import importlib.util
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from selective_depth.app import cli
from selective_depth.app.demo.guard import COOKIE, Guard
from selective_depth.app.viewer import free_port, serving_web_viewer, web_address

ROOT = Path(__file__).parents[2]


def knock(guard: Guard, kind: str = "http", query: str = "", **headers: str) -> tuple[int, dict[str, str]]:
    """Status and headers of the answer to a request; of a web socket 101 if it is let in, else its closing code."""
    scope = {
        "type": kind,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    }
    answers: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        answers.append(dict(message))

    async def receive() -> dict[str, Any]:
        return {}

    asyncio.run(guard(scope, receive, send))
    first = answers[0]
    if kind == "websocket":
        return first.get("code", 101), {}
    return first["status"], {name.decode(): value.decode() for name, value in first["headers"]}


async def page(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"page"})


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("headers", "let_in"),
    [
        ({"host": "127.0.0.1:8080"}, True),
        ({"host": "localhost:8080"}, True),
        ({"host": "[::1]:8080"}, True),
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:8080"}, True),
        ({"host": "127.0.0.1:8080", "origin": "http://evil.example"}, False),
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:9090"}, False),  # the viewer's own page
        ({"host": "127.0.0.1:8080", "origin": "null"}, False),
        ({"host": "evil.example:8080"}, False),  # a name that points here
        ({"host": "127.0.0.1.evil.example:8080"}, False),
        ({}, False),
    ],
)
def test_only_this_machines_own_page_is_answered(kind: str, headers: dict[str, str], let_in: bool) -> None:
    good, bad = (101, 1008) if kind == "websocket" else (200, 403)
    assert knock(Guard(page), kind, **headers)[0] == (good if let_in else bad)


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_a_shared_page_needs_its_token(kind: str) -> None:
    guard, host = Guard(page, "secret"), "192.0.2.7:8080"
    good, bad = (101, 1008) if kind == "websocket" else (200, 403)
    assert knock(guard, kind, host=host)[0] == bad
    assert knock(guard, kind, "token=guess", host=host)[0] == bad
    assert knock(guard, kind, "token=secret", host=host)[0] == good
    assert knock(guard, kind, host=host, cookie=f"{COOKIE}=guess")[0] == bad
    assert knock(guard, kind, host=host, cookie=f"a=b; {COOKIE}=secret")[0] == good
    assert knock(guard, kind, host=host, cookie=f"{COOKIE}=secret", origin="http://evil.example")[0] == bad
    assert knock(guard, kind, host=host, cookie="\x00=;;=")[0] == bad


def test_the_token_becomes_a_cookie_that_no_script_and_no_other_page_gets() -> None:
    _, headers = knock(Guard(page, "secret"), query="token=secret", host="192.0.2.7:8080")
    assert headers["set-cookie"] == f"{COOKIE}=secret; Path=/; HttpOnly; SameSite=Strict"
    assert headers["x-frame-options"] == "DENY"
    assert "set-cookie" not in knock(Guard(page, "secret"), host="h:1", cookie=f"{COOKIE}=secret")[1]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, Path]]:
    """The command as people start it: its port, and the file of what it prints."""
    folder = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "selective_depth.app", "demo", str(ROOT / "recordings" / "workstation.oni")]
    command += ["--no-browser", "--port", "18080"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
    try:
        deadline_s = time.monotonic() + 60
        while not (found := re.search(r"The page is at http://127.0.0.1:(\d+)/", (folder / "log").read_text())):
            assert process.poll() is None and time.monotonic() < deadline_s, (folder / "log").read_text()
            time.sleep(0.1)
        yield int(found[1]), folder / "log"
    finally:
        process.terminate()
        process.wait(30)
    assert "Traceback" not in (folder / "log").read_text()


def get(port: int, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/", headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_the_page_is_there_with_its_controls_and_the_viewer(demo: tuple[int, Path]) -> None:
    status, text = get(demo[0])
    assert status == 200
    for name in ("budget", "rounds", "by", "memory", "layout", "hide", "paused", "reset", "recording", "snapshot"):
        assert re.search(rf"data-name\W+{name}\b", text), name
    assert "rerun%2Bhttp" in text and "googleapis" not in text


def test_the_page_refuses_names_and_origins_that_are_not_its_own(demo: tuple[int, Path]) -> None:
    assert get(demo[0], Host="evil.example")[0] == 403
    assert get(demo[0], Origin="http://evil.example")[0] == 403


def test_only_the_pages_own_viewer_reads_the_stream(demo: tuple[int, Path]) -> None:
    """The stream itself tells browsers whose pages may: those of this machine, on no other's behalf."""
    joined = re.search(r"rerun\+http://127.0.0.1:(\d+)/proxy", demo[1].read_text())
    viewer = re.search(r"http://localhost:(\d+)/\?url=", get(demo[0])[1])
    assert joined is not None and viewer is not None

    def allowed(origin: str) -> bool:
        connection = http.client.HTTPConnection("127.0.0.1", int(joined[1]), timeout=20)
        asks = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        connection.request("OPTIONS", "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages", headers=asks)
        return connection.getresponse().getheader("access-control-allow-origin") == origin

    assert allowed(f"http://localhost:{viewer[1]}") and allowed(f"http://127.0.0.1:{viewer[1]}")
    assert not allowed("http://evil.example") and not allowed(f"http://evil.example:{viewer[1]}")


def test_a_source_that_is_not_there_has_no_page(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.run(["demo", str(tmp_path / "no.oni"), "--no-browser"]) == 1
    shown = capsys.readouterr()
    assert "does not exist" in shown.err and "The page is at" not in shown.out


def test_nothing_of_it_listens_to_the_network(demo: tuple[int, Path]) -> None:
    """All ports that the demo's processes listen on are loopback's; what is open otherwise is somebody else's."""
    table = Path("/proc/net/tcp").read_text().splitlines()[1:]
    listening = {tuple(line.split()[1].split(":")) for line in table if line.split()[3] == "0A"}
    ours = {port for address, port in listening if int(port, 16) in (demo[0], *range(9090, 9100), *range(9876, 9886))}
    assert f"{demo[0]:04X}" in ours and len(ours) >= 3
    assert not [port for address, port in listening if port in ours and address != "0100007F"]


def test_the_viewer_for_browsers_is_served_and_gone_again() -> None:
    with serving_web_viewer("127.0.0.1", 9999) as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("GET", "/")
        assert b"Rerun" in connection.getresponse().read()
    with pytest.raises(OSError), socket.create_connection(("127.0.0.1", port), 1):
        pass
    assert web_address("host", 1, 2).startswith("http://host:1/?url=rerun%2Bhttp%3A%2F%2Fhost%3A2%2Fproxy&")


def test_the_viewer_for_browsers_goes_with_a_program_that_is_killed() -> None:
    script = (
        "import time\nfrom selective_depth.app.viewer import serving_web_viewer\n"
        "with serving_web_viewer('127.0.0.1', 9999) as port:\n    print(port, flush=True)\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline())
        process.kill()
    deadline_s = time.monotonic() + 10
    while socket.socket().connect_ex(("127.0.0.1", port)) == 0:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_the_next_free_port_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert free_port("127.0.0.1", range(port, port + 5)) > port
        from selective_depth.app.console.errors import ViewerError

        with pytest.raises(ViewerError, match="are all taken"):
            free_port("127.0.0.1", [port])


def test_without_its_extra_the_demo_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "nicegui" else plain(name, *rest)
    )
    assert cli.run(["demo"]) == 2
    assert "pip install 'selective-depth[demo]'" in capsys.readouterr().err


def test_the_demos_help_needs_no_extra() -> None:
    """In a process of its own, which cannot import the framework."""
    script = (
        "import sys; sys.modules['nicegui'] = None\nfrom selective_depth.app.cli import run\nrun(['demo', '--help'])"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "--share" in shown.stdout and "selective-depth[demo]" in shown.stdout, shown.stderr
