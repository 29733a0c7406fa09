"""Who may use the page: this machine's own browsers, or whoever has the token."""

from __future__ import annotations

import secrets
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

COOKIE = "selective-depth-token"
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


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

    def __init__(self, app: ASGIApp, token: str = "") -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Hand a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        given = request.query_params.get("token", "")
        refusal = self._refusal(request, given)
        if refusal:
            answer = WebSocketClose(1008) if scope["type"] == "websocket" else PlainTextResponse(refusal, 403)
            await answer(scope, receive, send)
            return

        async def send_with(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.append("x-frame-options", "DENY")  # no other page may show this one, to have it clicked unseen
                if given:
                    headers.append("set-cookie", f"{COOKIE}={self._token}; Path=/; HttpOnly; SameSite=Strict")
            await send(message)

        await self._app(scope, receive, send_with)

    def _refusal(self, request: HTTPConnection, given: str) -> str:
        """Why a request is refused; empty if it is not."""
        host = request.headers.get("host", "")
        if not self._token and host.rpartition(":")[0] not in _LOOPBACK:
            return "This page answers to addresses of its own machine only; start it with --share for others."
        origin = request.headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "This page is not to be used by other pages."
        known = given or request.cookies.get(COOKIE, "")
        if self._token and not secrets.compare_digest(known.encode(), self._token.encode()):
            return "The address of this page ends in ?token=..., as it was printed where it was started."
        return ""
