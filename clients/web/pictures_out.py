"""Pictures on their way to a browser: of each place the newest, over a websocket."""

from __future__ import annotations

import asyncio

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState

from clients.web.wishes import Seen


class PicturesOut:
    """What one page has yet to be sent; for the event loop's thread.

    A picture that was not sent yet is dropped for a newer one of the same place: a slow
    connection is late by one picture and not by many.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, Seen] = {}
        self._last: dict[str, Seen] = {}
        self._came = asyncio.Event()

    def put(self, seen: Seen) -> None:
        """Leave a picture to be sent."""
        self._waiting[seen.place] = self._last[seen.place] = seen
        self._came.set()

    def last(self, place: str) -> Seen | None:
        """Return what was last shown at a place."""
        return self._last.get(place)

    async def serve(self, socket: WebSocket) -> None:
        """Send until the other side is gone; one that comes back gets all again."""
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
            pass  # it went while something was being sent
        except RuntimeError:
            if _is_open(socket) and not gone.done():
                raise  # another fault is ours
        finally:
            gone.cancel()


def _is_open(socket: WebSocket) -> bool:
    states = socket.client_state, socket.application_state
    return all(state is WebSocketState.CONNECTED for state in states)


async def _gone(socket: WebSocket) -> None:
    """Wait until the other side is gone; it says nothing else."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
