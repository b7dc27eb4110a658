"""HTTP server.

It serves the NiceGUI app with token authentication and request limits, and a websocket
for images. uvicorn itself limits neither the number of connections nor the time to
receive a request's head, nor, with httptools, its size: see `BoundedConnection`.
"""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

import uvicorn
from fastapi import FastAPI, WebSocket
from fastapi.exception_handlers import http_exception_handler
from nicegui import app, ui
from uvicorn.protocols.http.h11_impl import H11Protocol

from clients.web.guard import MAX_MESSAGE_BYTES, POLICY_VIOLATION, Bounds, Guard
from clients.web.page import PICTURES_PATH, SharedResources, add_page
from clients.web.page_state import SCENES
from clients.web.picture import SceneNotRendered, scene_picture

MESSAGE_HISTORY = 50
"""Messages buffered for a reconnecting browser; kept low because figures are large."""

SHUTDOWN_TIMEOUT_S = 2

MAX_HEAD_BYTES = 32_768
"""Size limit of a request line with its headers, for `uvicorn.Config`."""

_WATCH_NUMBERS = itertools.count()  # the clock of uvloop has milliseconds only


class BoundedConnection(H11Protocol):
    """uvicorn's HTTP/1.1 connection, with limits.

    Attributes
    ----------
    head_s : float
        Time limit for receiving the head of the next request.
    max_connections : int
        Maximum number of concurrent connections, including websockets; a page takes up
        to 8.  Beyond it, a connection that awaits a request is closed: first those that
        have not sent one yet, then idle ones, the oldest first.  If there is none, the
        new connection is closed.
    """

    head_s = 10.0
    max_connections = 256
    _deadline: asyncio.TimerHandle | None = None
    _watch_number = 0

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Accept the connection; close one that is silent if there are too many."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            waiting = [c for c in self.connections if isinstance(c, BoundedConnection)]
            silent = min(waiting, key=lambda c: c._silence)
            self.connections.discard(silent)  # it is closed later
            silent._stop_watching()
            silent.transport.abort()
            if silent is self:
                return
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Process a part of a request."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop_watching()
        super().connection_lost(exc)

    @property
    def _silence(self) -> tuple[bool, bool, int]:
        """Return a key by which to sort connections: the one to close comes first."""
        return self._deadline is None, self.cycle is not None, self._watch_number

    def _watch(self) -> None:
        """Start the timer while a request is awaited, stop it while one is handled."""
        is_awaited = self.cycle is None or self.cycle.response_complete
        if not is_awaited or self.transport.get_protocol() is not self:
            self._stop_watching()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(self.head_s, self.transport.abort)
            self._watch_number = next(_WATCH_NUMBERS)

    def _stop_watching(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def _render_default_scene() -> None:
    with suppress(SceneNotRendered):  # the page shows the error
        scene_picture(SCENES[0])


def make_server(
    token: str,
    port: int,
    profile: tuple[Mapping[str, Any], str] | None,
    *,
    one_time_token: str | None = None,
    hosts: Collection[str] | None = None,
    is_behind_proxy: bool = False,
    on_ready: Callable[[], None],
) -> uvicorn.Server:
    """Return the server.  Pass the listening sockets to its `run` method.

    Parameters
    ----------
    one_time_token, hosts : as in `Guard`
    is_behind_proxy : bool
        Whether a proxy on this machine tells the scheme of a request, in
        ``X-Forwarded-Proto``.
    """
    resources = SharedResources()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # render the default scene now, so that the first page load can show it at once
        threading.Thread(target=_render_default_scene, daemon=True).start()
        on_ready()
        yield

    application = FastAPI(
        docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan
    )

    @application.websocket(PICTURES_PATH + "{page}")
    async def _pictures(socket: WebSocket, page: str) -> None:
        sender = resources.picture_senders.get(page)
        if sender is None:
            await socket.close(POLICY_VIOLATION)
        else:
            await sender.serve(socket)

    add_page(resources, profile, token)
    ui.run_with(
        application,
        title="ocufilter",
        language="en-US",
        favicon="👁",
        tailwind=False,
        binding_refresh_interval=None,  # there are no bindings
        message_history_length=MESSAGE_HISTORY,
        show_welcome_message=False,
    )
    # NiceGUI's own handler creates a page for each unknown address
    app.add_exception_handler(404, http_exception_handler)
    bounded = Bounds(application, is_full=lambda: resources.are_full)
    guarded = Guard(
        bounded,
        token=token,
        cookie=f"ocufilter-{port}",
        one_time_token=one_time_token,
        hosts=hosts,
    )
    return uvicorn.Server(
        uvicorn.Config(
            guarded,
            log_config=None,  # as the program has configured it
            log_level="warning",
            timeout_graceful_shutdown=SHUTDOWN_TIMEOUT_S,
            http=BoundedConnection,
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            ws_max_size=MAX_MESSAGE_BYTES,
            server_header=False,
            proxy_headers=is_behind_proxy,
            forwarded_allow_ips=["127.0.0.1", "::1"],
        )
    )
