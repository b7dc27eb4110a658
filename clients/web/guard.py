"""Who may open the page: whoever has the token that was printed with its address.

An ASGI layer around the whole application, files and websockets alike.  The first
visit with the token in the address gets a cookie and is sent on without the token.
"""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, Mapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

Scope = Mapping[str, Any]
Send = Callable[[Mapping[str, Any]], Awaitable[None]]
Application = Callable[[Any, Any, Any], Awaitable[None]]

FORBIDDEN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>ocufilter: no entry</title>
<style>body{font:16px/1.5 system-ui,sans-serif;color:#1b2430;background:#f4f6f8;
max-width:34rem;margin:15vh auto;padding:0 1.5rem}code{background:#e3e8ee;
padding:.1em .35em;border-radius:4px}</style>
<h1>This page wants its token</h1>
<p>Open the whole address that <code>ocufilter web</code> printed when it started; it
ends with <code>?token=...</code>.  After a restart the token is another one.</p>
"""
POLICY_VIOLATION = 1008
"""Code with which a websocket is closed that may not be opened."""


class Guard:
    """Lets through what brings the token, in the address or as a cookie.

    Parameters
    ----------
    app : ASGI application
    token : str
    cookie : str
        Name of the cookie; cookies know no ports, so that it should.
    """

    def __init__(self, app: Application, *, token: str, cookie: str) -> None:
        self.app = app
        self._token, self._cookie = token, cookie

    async def __call__(self, scope: Any, receive: Any, send: Send) -> None:
        """Answer one connection."""
        kind = scope["type"]
        if kind not in ("http", "websocket"):  # the server's own start and end
            await self.app(scope, receive, send)
        elif kind == "http" and self._has_token(scope):
            await self._welcome(scope, send)
        elif self._has_cookie(scope) and is_from_here(scope):
            await self.app(scope, receive, send)
        elif kind == "http":
            await _answer(send, 403, FORBIDDEN_PAGE.encode())
        else:
            await receive()  # its request to connect
            await send({"type": "websocket.close", "code": POLICY_VIOLATION})

    def _has_token(self, scope: Scope) -> bool:
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])
        return self._is_token(given[0])

    def _has_cookie(self, scope: Scope) -> bool:
        try:
            jar = SimpleCookie(_header(scope, b"cookie"))
        except CookieError:
            return False
        return self._cookie in jar and self._is_token(jar[self._cookie].value)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    async def _welcome(self, scope: Scope, send: Send) -> None:
        cookie = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
        # the token stays neither in the address bar nor in the browser's history
        headers = [
            (b"set-cookie", cookie.encode("latin-1")),
            (b"location", b"/"),
        ]
        await _answer(send, 303, b"", headers)


def is_from_here(scope: Scope) -> bool:
    """Return whether a request comes from our own page, or from no page at all.

    A page of another port of this machine brings our cookie along; its origin tells.
    """
    origin = _header(scope, b"origin")
    return not origin or urlsplit(origin).netloc == _header(scope, b"host")


def _header(scope: Scope, name: bytes) -> str:
    values = [value for key, value in scope["headers"] if key == name]
    return b"; ".join(values).decode("latin-1")


async def _answer(
    send: Send,
    status: int,
    body: bytes,
    headers: list[tuple[bytes, bytes]] | None = None,
) -> None:
    common = [
        (b"content-type", b"text/html; charset=utf-8"),
        (b"cache-control", b"no-store"),
        (b"referrer-policy", b"no-referrer"),
        (b"content-length", str(len(body)).encode()),
    ]
    await send(
        {
            "type": "http.response.start",
            "status": status,
            "headers": common + (headers or []),
        }
    )
    await send({"type": "http.response.body", "body": body})
