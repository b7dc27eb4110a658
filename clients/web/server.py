"""HTTP server.

It serves the NiceGUI app with token authentication and request limits, and a websocket
for images.
"""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

import uvicorn
from fastapi import FastAPI, WebSocket
from fastapi.exception_handlers import http_exception_handler
from nicegui import app, ui

from clients.web.bounds import MAX_MESSAGE_BYTES, Bounds
from clients.web.connections import MAX_HEAD_BYTES, BoundedConnection
from clients.web.guard import POLICY_VIOLATION, Guard
from clients.web.page import PICTURES_PATH, SharedResources, add_page
from clients.web.scene_file import SceneNotRendered, scene_picture
from clients.web.scene_panel import DEFAULT_SCENE

MESSAGE_HISTORY = 50
"""Messages buffered for a reconnecting browser; kept low because figures are large."""

SHUTDOWN_TIMEOUT_S = 2


def _render_default_scene() -> None:
    with suppress(SceneNotRendered):  # the page shows the error
        scene_picture(DEFAULT_SCENE)


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
    resources: list[SharedResources] = []

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
        sender = resources[0].picture_senders.get(page)
        if sender is None:
            await socket.close(POLICY_VIOLATION)
        else:
            await sender.serve(socket)

    resources.append(SharedResources())
    add_page(resources[0], profile, token)
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
    bounded = Bounds(application, is_full=lambda: resources[0].are_full)
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
