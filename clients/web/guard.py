"""Access control by token, and limits on requests, as ASGI layers.

`Guard` stands around the whole application, files and websockets alike: a client needs
the token in the address that the program prints. The first visit with the token in the
address sets a cookie and redirects to the address without the token. Requests from
other sites are refused even with the cookie.

`Bounds` stands inside the guard. It responds to a request that exceeds a limit (of
methods, paths, body sizes, and time to send a body) before the body is in memory; the
application then sees a disconnected client.
"""

from __future__ import annotations

import asyncio
import hmac
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
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
"""Close code of a rejected websocket."""

MAX_MESSAGE_BYTES = 1_000_000
"""Size limit of websocket messages and of requests other than uploads, as in
Engine.IO."""

MAX_UPLOAD_BYTES = 201_000_000
"""Size limit of an upload request: the largest file, a glTF scene, in its multipart
envelope."""

MAX_PAGES = 32
"""Maximum number of open pages; each has its own eyes, with tens of MB of PSFs."""

FULL = f"{MAX_PAGES} pages are open; close one and reload this page"

PAGE_PATH = "/"
KNOWN_PREFIXES = ("/_nicegui/", "/_nicegui_ws/", "/favicon.ico")
UPLOAD_PREFIX, UPLOAD_PART = "/_nicegui/client/", "/upload/"

READ_METHODS, ALL_METHODS = ("GET", "HEAD"), ("GET", "HEAD", "POST")

MAX_STEM_CHARACTERS, MAX_SUFFIX_CHARACTERS = 60, 8


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
            return
        is_ours = self._is_addressed_to_us(scope)
        if is_ours and kind == "http" and self._has_token(scope):
            is_tls = scope.get("scheme") == "https"
            await self._redirect_with_cookie(send, is_tls=is_tls)
        elif is_ours and self._has_cookie(scope) and _is_from_here(scope):
            await self.app(scope, receive, _with_headers(send))
        elif kind == "websocket":
            await receive()  # the connect event
            await send({"type": "websocket.close", "code": POLICY_VIOLATION})
        elif is_ours:
            await _refuse(send, 403, FORBIDDEN_PAGE)
        else:
            await _refuse(send, 421, page_of("Unknown host"))

    def _is_addressed_to_us(self, scope: Scope) -> bool:
        """Return whether the Host header names us.

        Otherwise the browser may have reached us under another site's name.
        """
        return self._hosts is None or _host_name(_header(scope, b"host")) in self._hosts

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
        pairs = (part.partition("=") for part in _header(scope, b"cookie").split(";"))
        return any(
            name.strip() == self._cookie and _is_same(value.strip(), self._token)
            for name, _, value in pairs
        )

    async def _redirect_with_cookie(self, send: Send, *, is_tls: bool) -> None:
        # not Strict: after a link on another site, a browser would not send it to the
        # address that it is redirected to
        cookie = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Lax"
        # a browser would not return a Secure cookie over plain HTTP
        cookie += "; Secure" if is_tls else ""
        # keeps the token out of the address bar and the browser's history
        headers = [(b"set-cookie", cookie.encode("latin-1")), (b"location", b"/")]
        await _answer(send, 303, b"", headers)


def _is_same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _is_from_here(scope: Scope) -> bool:
    """Return whether a request comes from our own page, or from no page at all.

    A page on another port of this machine sends our cookie too, but with its own
    origin. For requests without an origin, browsers report the site in
    `Sec-Fetch-Site`; another site may only link to the page.
    """
    if _header(scope, b"sec-fetch-site") in ("same-site", "cross-site"):
        mode = _header(scope, b"sec-fetch-mode"), _header(scope, b"sec-fetch-dest")
        if mode != ("navigate", "document"):
            return False
    origin = _header(scope, b"origin")
    try:
        return not origin or urlsplit(origin).netloc == _header(scope, b"host")
    except ValueError:  # not a valid address
        return False


def _host_name(host: str) -> str | None:
    """Return the name in a Host header without the port; None if invalid."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _header(scope: Scope, name: bytes) -> str:
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


async def _refuse(send: Send, status: int, page: bytes) -> None:
    # the rest of the body is not read
    await _answer(send, status, page, [(b"connection", b"close")])


async def _answer(
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


@dataclass(frozen=True)
class Limits:
    """Limits of a request.

    Attributes
    ----------
    message_bytes, upload_bytes : int
    body_s : float
        Time limit for receiving a body.
    uploads : int
        Maximum number of concurrent uploads; each is received in a temporary file.
    """

    message_bytes: int = MAX_MESSAGE_BYTES
    upload_bytes: int = MAX_UPLOAD_BYTES
    body_s: float = 300.0
    uploads: int = 4


class Bounds:
    """Respond to requests beyond the limits, and pass on the others.

    Parameters
    ----------
    app : ASGI application
    is_full : callable
        Returns whether the maximum number of pages is open.
    """

    def __init__(
        self,
        app: Application,
        *,
        is_full: Callable[[], bool] = lambda: False,
        limits: Limits | None = None,
    ) -> None:
        self.app = app
        self._is_full = is_full
        self._limits = limits or Limits()
        self._n_uploads = 0

    async def __call__(self, scope: Any, receive: Any, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        path = scope["path"]
        is_upload = (
            scope["method"] == "POST"
            and path.startswith(UPLOAD_PREFIX)
            and UPLOAD_PART in path
        )
        limits = self._limits
        most = limits.upload_bytes if is_upload else limits.message_bytes
        refusal = self._refusal(scope, is_upload, most)
        if refusal is not None:
            status, reason = refusal
            await _refuse(send, status, page_of(reason))
            return
        body = _BoundedBody(receive, send, most, limits)
        self._n_uploads += is_upload
        try:
            await self.app(scope, body.receive, body.send)
        except Exception:
            if not body.is_over:  # the application raises because the client is gone
                raise
        finally:
            self._n_uploads -= is_upload

    def _refusal(
        self, scope: Scope, is_upload: bool, most: int
    ) -> tuple[int, str] | None:
        """Return status and reason if the head of a request is rejected, else None."""
        method, path = scope["method"], scope["path"]
        if method not in ALL_METHODS:
            return 405, f"{method:.20}: expected GET, HEAD or POST"
        if "\0" in path or (path != PAGE_PATH and not path.startswith(KNOWN_PREFIXES)):
            return 404, "Page not found"
        length = _header(scope, b"content-length")
        if length and (not length.isdecimal() or len(length) > 18):
            return 400, "Content-Length: expected a number of bytes"
        if length and int(length) > most:
            return 413, _too_large(most)
        if is_upload and self._n_uploads >= self._limits.uploads:
            return 503, f"{self._limits.uploads} uploads at a time; try again later"
        if path == PAGE_PATH and method in READ_METHODS and self._is_full():
            return 503, FULL
        return None


class _BoundedBody:
    """Body of one request; responds itself if the body exceeds a limit."""

    def __init__(self, receive: Any, send: Send, max_bytes: int, limits: Limits):
        self._receive, self._send = receive, send
        self._max_bytes, self._remaining = max_bytes, max_bytes
        self._body_s = limits.body_s
        self._deadline_s = asyncio.get_running_loop().time() + limits.body_s
        self._is_complete = self._has_responded = self._has_started = False
        self.is_over = False

    async def receive(self) -> Any:
        if self._is_complete:  # the next event is the disconnect
            return await self._receive()
        if self.is_over:
            return {"type": "http.disconnect"}
        try:
            async with asyncio.timeout_at(self._deadline_s):
                message = await self._receive()
        except TimeoutError:
            return await self._stop(408, f"The body took more than {self._body_s:g} s")
        if message["type"] != "http.request":
            self.is_over = True
            return message
        self._remaining -= len(message.get("body", b""))
        if self._remaining < 0:
            return await self._stop(413, _too_large(self._max_bytes))
        self._is_complete = not message.get("more_body", False)
        return message

    async def send(self, message: Any) -> None:
        if not self._has_responded:
            self._has_started = True
            await self._send(message)

    async def _stop(self, status: int, reason: str) -> Any:
        self.is_over = True
        if not self._has_started:
            self._has_responded = True
            await _refuse(self._send, status, page_of(reason))
        return {"type": "http.disconnect"}


def _too_large(max_bytes: int) -> str:
    return f"Too large; allowed: {max_bytes / 1e6:g} MB"


def plain_name(sent: str) -> str:
    """Return a file name of a browser without folders, control characters and excess.

    For display and for saving.
    """
    name = sent.replace("\\", "/").rpartition("/")[2]
    shown = Path("".join(filter(str.isprintable, name)).strip(" ."))
    stem, suffix = shown.stem[:MAX_STEM_CHARACTERS], shown.suffix
    return (stem + suffix[:MAX_SUFFIX_CHARACTERS]) or "unnamed"
