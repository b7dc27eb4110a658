"""The page's server: NiceGUI within a guard, and a websocket for pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any

import uvicorn
from fastapi import FastAPI, WebSocket
from nicegui import ui

from clients.web.guard import POLICY_VIOLATION, Guard
from clients.web.page import PICTURES_PATH, Desk, add_page

MESSAGE_HISTORY = 50
"""Messages that are kept for a browser whose connection broke; figures are large."""

FAREWELL_S = 2


def make_server(
    token: str,
    port: int,
    profile: tuple[Mapping[str, Any], str] | None,
    *,
    on_ready: Callable[[], None],
) -> uvicorn.Server:
    """Return the server; its sockets are given to its `run`."""
    desk: list[Desk] = []

    @asynccontextmanager
    async def lifespan(_: FastAPI):
        on_ready()
        yield

    application = FastAPI(
        docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan
    )

    @application.websocket(PICTURES_PATH + "{page}")
    async def _pictures(socket: WebSocket, page: str) -> None:
        out = desk[0].out.get(page)
        if out is None:
            await socket.close(POLICY_VIOLATION)
        else:
            await out.serve(socket)

    desk.append(Desk())
    add_page(desk[0], profile)
    ui.run_with(
        application,
        title="ocufilter",
        favicon="👁",
        tailwind=False,
        binding_refresh_interval=None,  # nothing is bound
        message_history_length=MESSAGE_HISTORY,
        show_welcome_message=False,
    )
    guarded = Guard(application, token=token, cookie=f"ocufilter-{port}")
    return uvicorn.Server(
        uvicorn.Config(
            guarded, log_level="warning", timeout_graceful_shutdown=FAREWELL_S
        )
    )
