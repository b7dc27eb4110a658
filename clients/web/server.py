"""HTTP server: NiceGUI behind a guard and limits, and a websocket for pictures."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

import uvicorn
from fastapi import FastAPI, WebSocket
from fastapi.exception_handlers import http_exception_handler
from nicegui import app, ui

from clients.web.bounds import MAX_MESSAGE_BYTES, MAX_PAGES, Bounds
from clients.web.connections import MAX_HEAD_BYTES, BoundedConnection
from clients.web.guard import POLICY_VIOLATION, Guard
from clients.web.page import PICTURES_PATH, SharedResources, add_page
from clients.web.scene_file import SceneNotRendered, scene_picture
from clients.web.scene_panel import FIRST

MESSAGE_HISTORY = 50
"""Messages kept for a browser that reconnects; figures are large."""

FAREWELL_S = 2


def _render_first() -> None:
    with suppress(SceneNotRendered):  # the page says what is missing
        scene_picture(FIRST)


def make_server(
    token: str,
    port: int,
    profile: tuple[Mapping[str, Any], str] | None,
    *,
    opening: str | None = None,
    hosts: Collection[str] | None = None,
    on_ready: Callable[[], None],
) -> uvicorn.Server:
    """Return the server; pass its sockets to its `run`.

    Parameters
    ----------
    opening, hosts : as in `Guard`
    """
    resources: list[SharedResources] = []

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # rendered before somebody opens the page, which then opens with it
        threading.Thread(target=_render_first, daemon=True).start()
        on_ready()
        yield

    application = FastAPI(
        docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan
    )

    @application.websocket(PICTURES_PATH + "{page}")
    async def _pictures(socket: WebSocket, page: str) -> None:
        out = resources[0].out.get(page)
        if out is None:
            await socket.close(POLICY_VIOLATION)
        else:
            await out.serve(socket)

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
    bounded = Bounds(application, is_full=lambda: len(resources[0].out) >= MAX_PAGES)
    guarded = Guard(
        bounded,
        token=token,
        cookie=f"ocufilter-{port}",
        opening=opening,
        hosts=hosts,
    )
    return uvicorn.Server(
        uvicorn.Config(
            guarded,
            log_level="warning",
            timeout_graceful_shutdown=FAREWELL_S,
            http=BoundedConnection,
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            ws_max_size=MAX_MESSAGE_BYTES,
            server_header=False,
        )
    )
