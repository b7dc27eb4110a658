"""Textures that clients on this machine share with the render workers."""

from __future__ import annotations

import logging
from collections.abc import Callable

from filter_service.errors import BadMessage, FilterError
from filter_service.messages import (
    ErrorReply,
    Reply,
    SharedTexture,
    ShareTexture,
    TextureOffer,
    UnshareTexture,
    decode_request,
    peek_session_key,
)
from filter_service.service.connections import Peer
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import ClientTexture, Session
from filter_service.service.session_table import SessionTable
from filter_service.service.texture_socket import TextureSocket, close_all
from filter_service.wire.message import Limits

MAX_TEXTURES = 16
"""Maximum number of shared textures of one session."""

log = logging.getLogger("ocufilter")


class ClientTextures:
    """Passes descriptors of textures from clients to render workers.

    Parameters
    ----------
    texture_socket : TextureSocket or None
        None if the service does not offer shared textures.
    sessions : SessionTable
    devices : ServedDevices
    send : callable
        Sends a reply to a peer.
    """

    def __init__(
        self,
        texture_socket: TextureSocket | None,
        sessions: SessionTable,
        devices: ServedDevices,
        send: Callable[[Peer, Reply], object],
    ) -> None:
        self._socket = texture_socket
        self._sessions, self._devices, self._send = sessions, devices, send

    def offer_to(self, session: Session) -> TextureOffer | None:
        """Return what to offer to a session, which depends on its device."""
        support = self._devices.device_of(session).texture_support
        if self._socket is None or support is None:
            return None
        return TextureOffer(
            self._socket.name, support.device_uuids, support.driver_uuid
        )

    def receive(self, limits: Limits) -> None:
        """Handle the datagrams that have arrived."""
        if self._socket is None:
            return
        for data, descriptors in self._socket.receive():
            try:
                self._share(data, descriptors, limits)
            finally:
                close_all(descriptors)  # the worker has its own

    def _share(self, data: bytes, descriptors: list[int], limits: Limits) -> None:
        session = self._sessions.by_key(peek_session_key([data]))
        if session is None or session.peer is None:
            return
        try:
            request = decode_request([data], limits)
        except FilterError as error:
            self._send(session.peer, ErrorReply.from_exception(error))
            return
        if not isinstance(request, ShareTexture):
            return
        reason = self._refusal(session, request, descriptors)
        if reason:
            self._send(session.peer, SharedTexture(request.texture, reason))
            return
        session.textures[request.texture] = ClientTexture(request)
        render = self._devices.device_of(session).render
        render.send("texture", session.key, request, descriptors=descriptors)

    def _refusal(
        self, session: Session, request: ShareTexture, descriptors: list[int]
    ) -> str:
        """Return why not to import a texture, or an empty string."""
        device = self._devices.device_of(session)
        if device.texture_support is None:
            return f"the engine of device {device.name} imports no textures"
        if len(descriptors) != 1:
            return f"{len(descriptors)} descriptors came with it; expected 1"
        if request.texture in session.textures:
            return f"texture {request.texture} is shared already"
        if len(session.textures) >= MAX_TEXTURES:
            return f"{MAX_TEXTURES} textures are shared"
        on_device = self._sessions.connected_on(device.index)
        for owners, most in (
            ([session], device.render.session_quota_bytes),
            (on_device, device.render.shared_quota_bytes),
        ):
            used = sum(texture_bytes(owner) for owner in owners)
            if used + request.size_bytes > most:
                return (
                    f"size_bytes is {request.size_bytes}, and {used} bytes are shared; "
                    f"allowed: {most} in total"
                )
        return ""

    def accept_import(self, key: str, number: int, reason: str) -> None:
        """Handle the reply of a render worker."""
        session = self._sessions.by_key(key)
        if session is None or number not in session.textures:
            return
        if reason:
            log.info("session %d shares no texture: %s", session.session_id, reason)
            del session.textures[number]
        else:
            session.textures[number].is_imported = True
        if session.peer is not None:
            self._send(session.peer, SharedTexture(number, reason))

    def unshare(self, session: Session, request: UnshareTexture) -> None:
        """Release a texture that a client takes back.

        Raises
        ------
        BadMessage
            If the session has no such texture, or a frame uses it.
        """
        number = request.texture
        if number not in session.textures or number in session.textures_in_use:
            raise BadMessage(
                f"it is {number}",
                field="texture",
                allowed="a texture of this session that no frame uses",
            )
        del session.textures[number]
        self._devices.device_of(session).render.send(
            "drop_texture", session.key, number
        )

    def free(self, session: Session) -> None:
        """Release all textures of a session."""
        if session.textures:
            render = self._devices.device_of(session).render
            render.send("drop_textures", session.key)
        session.textures, session.textures_in_use = {}, set()

    def report_lost(self, device: ServedDevice) -> None:
        """Tell clients that their textures are lost with a render worker."""
        for session in self._sessions:
            if session.device != device.index:
                continue
            lost, session.textures = list(session.textures), {}
            session.textures_in_use = set()
            for number in lost:
                if session.peer is not None:
                    reply = SharedTexture(number, "the render worker exited")
                    self._send(session.peer, reply)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def texture_bytes(session: Session) -> int:
    """Return the total size of a session's textures."""
    return sum(texture.request.size_bytes for texture in session.textures.values())
