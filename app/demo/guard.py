"""Who may use the page: this machine's own browsers, or whoever has the token."""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Callable[[], Awaitable[Any]], Send], Awaitable[None]]
COOKIE = "selective-depth-token"
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_OURS_ALONE = (b"x-frame-options", b"DENY")
"""No other page may show this one, to have it clicked on unseen."""


class Guard:
    """Stands before the page, whatever framework made it.

    Without a token only addresses of this machine are answered to, and no page of another origin: else any
    site that is open in the browser could steer the run, by a name that it lets point here or by a web socket.

    Parameters
    ----------
    app : callable
        What is guarded (ASGI).
    token : str, optional
        What has to be known to be let in: once in the address, ``?token=``, from then on as a cookie.
    """

    def __init__(self, app: App, token: str = "") -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Callable[[], Awaitable[Any]], send: Send) -> None:
        """Hand a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        refusal = self._refusal(headers, given)
        if refusal:
            await _refuse(scope, send, refusal)
            return
        more = [_OURS_ALONE]
        if given:
            more.append((b"set-cookie", f"{COOKIE}={self._token}; Path=/; HttpOnly; SameSite=Strict".encode()))

        async def send_with(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *more]
            await send(message)

        await self._app(scope, receive, send_with)

    def _refusal(self, headers: dict[bytes, str], given: str) -> str:
        """Why a request is refused; empty if it is not."""
        host = headers.get(b"host", "")
        if not self._token and host.rpartition(":")[0] not in _LOOPBACK:
            return "This page answers to addresses of its own machine only; start it with --share for others."
        origin = headers.get(b"origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "This page is not to be used by other pages."
        if self._token and not secrets.compare_digest(given or _cookie(headers), self._token):
            return "The address of this page ends in ?token=..., as it was printed where it was started."
        return ""


def _cookie(headers: dict[bytes, str]) -> str:
    try:
        jar = SimpleCookie(headers.get(b"cookie", ""))
    except CookieError:
        return ""
    return jar[COOKIE].value if COOKIE in jar else ""


async def _refuse(scope: Scope, send: Send, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    kind = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": 403, "headers": kind})
    await send({"type": "http.response.body", "body": why.encode()})
