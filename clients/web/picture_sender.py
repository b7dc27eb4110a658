"""Send the newest picture of each slot to a browser over a websocket."""

from __future__ import annotations

import asyncio

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState

from clients.web.picture_requests import SentPicture


class PictureSender:
    """Queue of the pictures of one page; use it on the event loop's thread.

    A newer picture replaces a queued one of the same slot, so that a slow connection
    lags by one picture at most.
    """

    def __init__(self) -> None:
        self._queued: dict[str, SentPicture] = {}
        self._last: dict[str, SentPicture] = {}
        self._new_picture = asyncio.Event()

    def put(self, seen: SentPicture) -> None:
        """Queue a picture."""
        self._queued[seen.slot] = self._last[seen.slot] = seen
        self._new_picture.set()

    def last(self, slot: str) -> SentPicture | None:
        """Return the last picture of a slot."""
        return self._last.get(slot)

    async def serve(self, socket: WebSocket) -> None:
        """Send pictures until the client disconnects; resend all after a reconnect."""
        await socket.accept()
        self._queued = dict(self._last)
        self._new_picture.set()
        disconnected = asyncio.ensure_future(_wait_for_disconnect(socket))
        try:
            while not disconnected.done():
                new_picture = asyncio.ensure_future(self._new_picture.wait())
                await asyncio.wait(
                    {new_picture, disconnected}, return_when=asyncio.FIRST_COMPLETED
                )
                new_picture.cancel()
                self._new_picture.clear()
                while self._queued and not disconnected.done():
                    slot = next(iter(self._queued))
                    await socket.send_bytes(self._queued.pop(slot).packed())
        except WebSocketDisconnect:
            pass  # the client disconnected during a send
        except RuntimeError:
            if _is_open(socket) and not disconnected.done():
                raise  # any other error is ours
        finally:
            disconnected.cancel()


def _is_open(socket: WebSocket) -> bool:
    states = socket.client_state, socket.application_state
    return all(state is WebSocketState.CONNECTED for state in states)


async def _wait_for_disconnect(socket: WebSocket) -> None:
    """Wait until the client disconnects; it sends nothing else."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
