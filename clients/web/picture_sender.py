"""Send pictures to a browser over a websocket, the newest of each place."""

from __future__ import annotations

import asyncio

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState

from clients.web.picture_requests import SentPicture


class PictureSender:
    """Pictures of one page waiting to be sent; for the event loop's thread.

    A newer picture replaces a waiting one of the same place, so that a slow connection
    is late by one picture and not by many.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, SentPicture] = {}
        self._last: dict[str, SentPicture] = {}
        self._came = asyncio.Event()

    def put(self, seen: SentPicture) -> None:
        """Queue a picture."""
        self._waiting[seen.place] = self._last[seen.place] = seen
        self._came.set()

    def last(self, place: str) -> SentPicture | None:
        """Return the picture last shown at a place."""
        return self._last.get(place)

    async def serve(self, socket: WebSocket) -> None:
        """Send pictures until the client disconnects; resend all after a reconnect."""
        await socket.accept()
        self._waiting = dict(self._last)
        self._came.set()
        gone = asyncio.ensure_future(_gone(socket))
        try:
            while not gone.done():
                came = asyncio.ensure_future(self._came.wait())
                await asyncio.wait({came, gone}, return_when=asyncio.FIRST_COMPLETED)
                came.cancel()
                self._came.clear()
                while self._waiting and not gone.done():
                    place = next(iter(self._waiting))
                    await socket.send_bytes(self._waiting.pop(place).packed())
        except WebSocketDisconnect:
            pass  # it disconnected during a send
        except RuntimeError:
            if _is_open(socket) and not gone.done():
                raise  # any other error is ours
        finally:
            gone.cancel()


def _is_open(socket: WebSocket) -> bool:
    states = socket.client_state, socket.application_state
    return all(state is WebSocketState.CONNECTED for state in states)


async def _gone(socket: WebSocket) -> None:
    """Wait until the client disconnects; it sends nothing else."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
