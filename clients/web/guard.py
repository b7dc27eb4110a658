"""Access control: a client needs the token in the address that the program prints.

An ASGI layer around the whole application, files and websockets alike. The first visit
with the token in the address sets a cookie and redirects to the address without the
token. Requests from other sites are refused even with the cookie.
"""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, Collection, Mapping
from html import escape
from typing import Any
from urllib.parse import parse_qs, urlsplit

Scope = Mapping[str, Any]
Send = Callable[[Mapping[str, Any]], Awaitable[None]]
Application = Callable[[Any, Any, Any], Awaitable[None]]

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>ocufilter</title>
<style>body{{font:16px/1.5 system-ui,sans-serif;color:#1b2430;background:#f4f6f8;
max-width:34rem;margin:15vh auto;padding:0 1.5rem}}code{{background:#e3e8ee;
padding:.1em .35em;border-radius:4px}}</style>
<h1>{title}</h1>
{text}
"""
FORBIDDEN_PAGE = PAGE.format(
    title="This page needs its token",
    text="<p>Open the whole address that <code>ocufilter web</code> printed when it "
    "started; it ends with <code>?token=...</code>.  The token changes with every "
    "restart.</p>",
).encode()
HEADERS = [
    (b"content-security-policy", b"frame-ancestors 'none'"),
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"referrer-policy", b"no-referrer"),
]
"""Headers of every response: other pages can neither frame this one nor embed its
files."""

POLICY_VIOLATION = 1008
"""Close code of a websocket that is refused."""


class Guard:
    """Pass on requests that have the token, in the address or as a cookie.

    Parameters
    ----------
    app : ASGI application
    token : str
    cookie : str
        Name of the cookie; it should contain the port, which cookies ignore.
    one_time_token : str, optional
        A token that works once.  It goes on the browser's command line, which other
        users of the machine can read.
    hosts : collection of str, optional
        Host names that requests may be addressed to; any if not given.
    """

    def __init__(
        self,
        app: Application,
        *,
        token: str,
        cookie: str,
        one_time_token: str | None = None,
        hosts: Collection[str] | None = None,
    ) -> None:
        self.app = app
        self._token, self._cookie = token, cookie
        self._one_time_token, self._hosts = one_time_token, hosts

    async def __call__(self, scope: Any, receive: Any, send: Send) -> None:
        """Handle one connection."""
        kind = scope["type"]
        if kind not in ("http", "websocket"):  # lifespan events of the server
            await self.app(scope, receive, send)
        elif not self._is_addressed_to_us(scope):
            await _refuse(kind, receive, send, 421, page_of("Unknown host"))
        elif kind == "http" and self._has_token(scope):
            is_tls = scope.get("scheme") == "https"
            await self._redirect_with_cookie(send, is_tls=is_tls)
        elif self._has_cookie(scope) and is_from_here(scope):
            await self.app(scope, receive, _with_headers(send))
        else:
            await _refuse(kind, receive, send, 403, FORBIDDEN_PAGE)

    def _is_addressed_to_us(self, scope: Scope) -> bool:
        """Return whether the Host header names us.

        Otherwise the browser may have reached us under another site's name.
        """
        return self._hosts is None or host_name(header(scope, b"host")) in self._hosts

    def _has_token(self, scope: Scope) -> bool:
        query = scope["query_string"].decode("latin-1")
        given = parse_qs(query).get("token", [""])[0]
        if _is_same(given, self._token):
            return True
        if self._one_time_token is None or not _is_same(given, self._one_time_token):
            return False
        self._one_time_token = None
        return True

    def _has_cookie(self, scope: Scope) -> bool:
        # Not with http.cookies: it takes 13 s for a header of 64 kB of backslashes, and
        # finds nothing in a header in which another program's cookie is JSON.
        pairs = (part.partition("=") for part in header(scope, b"cookie").split(";"))
        return any(
            name.strip() == self._cookie and _is_same(value.strip(), self._token)
            for name, _, value in pairs
        )

    async def _redirect_with_cookie(self, send: Send, *, is_tls: bool) -> None:
        # not Strict: after a link on another site, a browser would not send it to the
        # address that it is redirected to
        cookie = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Lax"
        if is_tls:  # a browser would not return a Secure cookie over plain HTTP
            cookie += "; Secure"
        # keeps the token out of the address bar and the browser's history
        headers = [
            (b"set-cookie", cookie.encode("latin-1")),
            (b"location", b"/"),
        ]
        await answer(send, 303, b"", headers)


def _is_same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def is_from_here(scope: Scope) -> bool:
    """Return whether a request comes from our own page, or from no page at all.

    A page on another port of this machine sends our cookie too, but with its own
    origin. For requests without an origin, browsers report the site in
    `Sec-Fetch-Site`; another site may only link to the page.
    """
    if header(scope, b"sec-fetch-site") in ("same-site", "cross-site"):
        mode = header(scope, b"sec-fetch-mode"), header(scope, b"sec-fetch-dest")
        if mode != ("navigate", "document"):
            return False
    origin = header(scope, b"origin")
    try:
        return not origin or urlsplit(origin).netloc == header(scope, b"host")
    except ValueError:  # not a valid address
        return False


def host_name(host: str) -> str | None:
    """Return the name in a Host header without the port; None if invalid."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def header(scope: Scope, name: bytes) -> str:
    """Return the value of a header; an empty string if absent."""
    values = [value for key, value in scope["headers"] if key == name]
    return b"; ".join(values).decode("latin-1")


def page_of(title: str) -> bytes:
    """Return a page with one line of text."""
    return PAGE.format(title=escape(title), text="").encode()


def _with_headers(send: Send) -> Send:
    async def send_more(message: Mapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            names = {name for name, _ in HEADERS}
            given = [
                pair for pair in message.get("headers", ()) if pair[0] not in names
            ]
            message = {**message, "headers": given + HEADERS}
        await send(message)

    return send_more


async def _refuse(
    kind: str, receive: Any, send: Send, status: int, page: bytes
) -> None:
    if kind == "http":  # the rest of the body is not read
        await answer(send, status, page, [(b"connection", b"close")])
    else:
        await receive()  # the connect event
        await send({"type": "websocket.close", "code": POLICY_VIOLATION})


async def answer(
    send: Send,
    status: int,
    body: bytes,
    headers: list[tuple[bytes, bytes]] | None = None,
) -> None:
    """Respond to a request with a page."""
    common = [
        (b"content-type", b"text/html; charset=utf-8"),
        (b"cache-control", b"no-store"),
        (b"content-length", str(len(body)).encode()),
        *HEADERS,
    ]
    await send(
        {
            "type": "http.response.start",
            "status": status,
            "headers": common + (headers or []),
        }
    )
    await send({"type": "http.response.body", "body": body})
