"""Limits on HTTP requests: methods, paths, body sizes, and time to send a body.

An ASGI middleware inside the guard. It responds to a request that exceeds a limit
before the body is in memory; the application then sees a disconnected client.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from clients.web.guard import Application, Scope, Send, answer, header, page_of

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
        is_upload = _is_upload(scope)
        refusal = self._refusal(scope, is_upload)
        if refusal is not None:
            await _refuse(send, *refusal)
            return
        body = _BoundedBody(receive, send, self._max_bytes(is_upload), self._limits)
        self._n_uploads += is_upload
        try:
            await self.app(scope, body.receive, body.send)
        except Exception:
            if not body.is_over:  # the application raises because the client is gone
                raise
        finally:
            self._n_uploads -= is_upload

    def _max_bytes(self, is_upload: bool) -> int:
        limits = self._limits
        return limits.upload_bytes if is_upload else limits.message_bytes

    def _refusal(self, scope: Scope, is_upload: bool) -> tuple[int, str] | None:
        """Return status and reason if the request is refused by its head; else None."""
        method, path = scope["method"], scope["path"]
        if method not in ALL_METHODS:
            return 405, f"{method:.20}: expected GET, HEAD or POST"
        if "\0" in path or (path != PAGE_PATH and not path.startswith(KNOWN_PREFIXES)):
            return 404, "Page not found"
        length = header(scope, b"content-length")
        if length and (not length.isdecimal() or len(length) > 18):
            return 400, "Content-Length: expected a number of bytes"
        most = self._max_bytes(is_upload)
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
            await _refuse(self._send, status, reason)
        return {"type": "http.disconnect"}


def _is_upload(scope: Scope) -> bool:
    path = scope["path"]
    return (
        scope["method"] == "POST"
        and path.startswith(UPLOAD_PREFIX)
        and UPLOAD_PART in path
    )


def _too_large(max_bytes: int) -> str:
    return f"Too large; allowed: {max_bytes / 1e6:g} MB"


async def _refuse(send: Send, status: int, reason: str) -> None:
    # the rest of the body is not read
    await answer(send, status, page_of(reason), [(b"connection", b"close")])
