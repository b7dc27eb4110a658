"""Shared memory and shared textures of clients on this machine.

Descriptors of textures arrive in separate datagrams.
"""

from __future__ import annotations

import array
import logging
import os
import secrets
import socket
import struct
from collections.abc import Callable
from contextlib import AbstractContextManager

from filter_service.errors import BadMessage, FilterError, OutOfMemory
from filter_service.messages import (
    MAX_HEADER_BYTES,
    ErrorReply,
    Reply,
    Share,
    Shared,
    SharedTexture,
    ShareTexture,
    TextureOffer,
    Unshare,
    UnshareTexture,
    decode_request,
    peek_session_key,
)
from filter_service.service.config import LOOPBACK_HOSTS, ServiceConfig
from filter_service.service.connections import Peer
from filter_service.service.render_client import RenderClient
from filter_service.service.served_devices import ServedDevice, ServedDevices
from filter_service.service.session import ClientTexture, Session, SessionTable
from filter_service.wire.message import Limits

NAME_BYTES = 16
MAX_DESCRIPTORS = 1
"""Further descriptors of a datagram are closed by the kernel."""

MAX_DATAGRAMS = 16
"""Datagrams per turn of the event loop: a flooding client must not delay the others."""

_CREDENTIALS = struct.Struct("3i")  # process, user, group
_ANCILLARY_BYTES = socket.CMSG_SPACE(_CREDENTIALS.size) + socket.CMSG_SPACE(
    MAX_DESCRIPTORS * array.array("i").itemsize
)


class TextureSocket:
    """Bound socket that receives descriptors.

    Parameters
    ----------
    reserve : callable
        Returns a context in which this process may open descriptors.

    Attributes
    ----------
    name : str
        Name of the socket, without the null byte that starts an abstract address.
    """

    def __init__(self, reserve: Callable[[], AbstractContextManager[None]]) -> None:
        self._reserve = reserve
        self.name = f"ocufilter-{secrets.token_hex(NAME_BYTES)}"
        self._socket = socket.socket(
            socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
        )
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind(f"\0{self.name}")

    def fileno(self) -> int:
        """Return the descriptor to poll."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, list[int]]]:
        """Return datagrams of this user, with descriptors that the caller then owns."""
        found: list[tuple[bytes, list[int]]] = []
        with self._reserve():
            for _ in range(MAX_DATAGRAMS):
                try:
                    data, ancillary, flags, _ = self._socket.recvmsg(
                        MAX_HEADER_BYTES + 1, _ANCILLARY_BYTES, socket.MSG_CMSG_CLOEXEC
                    )
                except BlockingIOError:
                    break
                user, descriptors = None, array.array("i")
                for level, kind, content in ancillary:
                    if level != socket.SOL_SOCKET:
                        continue
                    if kind == socket.SCM_CREDENTIALS:
                        user = _CREDENTIALS.unpack(content)[1]
                    elif kind == socket.SCM_RIGHTS:
                        descriptors.frombytes(content)
                is_whole = not flags & (socket.MSG_CTRUNC | socket.MSG_TRUNC)
                if user == os.geteuid() and is_whole:
                    found.append((data, descriptors.tolist()))
                else:
                    close_all(descriptors.tolist())
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def close_all(descriptors: list[int]) -> None:
    """Close descriptors."""
    for descriptor in descriptors:
        os.close(descriptor)


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
        """Return the offer to a session, which depends on its device."""
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


MAX_PARTS_PER_VIEW = 4
MAX_SHARED_SLOTS = 16
"""Maximum number of slots of one session."""


class ClientMemory:
    """Allocates and frees the shared memory of sessions.

    Parameters
    ----------
    config : ServiceConfig
    endpoint : str
        Endpoint that clients connect to.
    render_client_of : callable
        Returns the render client of a session's device, which owns the shared memory.
    """

    def __init__(
        self,
        config: ServiceConfig,
        endpoint: str,
        render_client_of: Callable[[Session], RenderClient],
    ) -> None:
        self._render_client_of = render_client_of
        self._limits = config.limits
        is_local = endpoint.startswith("ipc://") or any(
            endpoint.startswith(f"tcp://{host}:") for host in LOOPBACK_HOSTS
        )
        self.is_offered = config.shared_memory and is_local and not config.keys_dir

    def share(self, session: Session, request: Share) -> Shared:
        """Allocate a slot for a client, or reply with the reason for refusal."""
        limits = self._limits
        max_bytes = MAX_PARTS_PER_VIEW * limits.max_views * limits.max_part_bytes
        if not self.is_offered:
            return Shared(
                reason="this service does not offer shared memory over this transport"
            )
        if len(session.shared) >= MAX_SHARED_SLOTS:
            return Shared(reason=f"{MAX_SHARED_SLOTS} slots are in use")
        if request.size_bytes > max_bytes:
            return Shared(
                reason=f"size_bytes is {request.size_bytes}; allowed: up to {max_bytes}"
            )
        render = self._render_client_of(session)
        shared_bytes = sum(slot.size_bytes for slot in session.shared.values())
        if shared_bytes + request.size_bytes > render.session_quota_bytes:
            return Shared(
                reason=f"size_bytes is {request.size_bytes}, and this session has "
                f"{shared_bytes}; allowed: {render.session_quota_bytes} in total"
            )
        try:
            slot = render.share(request.size_bytes)
        except OutOfMemory as error:
            return Shared(reason=str(error))
        session.shared[slot.number] = slot
        return Shared(slot.number, slot.size_bytes, slot.path)

    def unshare(self, session: Session, request: Unshare) -> None:
        """Free a slot that a client no longer needs.

        Raises
        ------
        BadMessage
            If the session has no such slot, or a frame uses it.
        """
        if request.slot not in session.shared or request.slot in session.slots_in_use:
            raise BadMessage(
                f"it is {request.slot}",
                field="slot",
                allowed="a slot of this session that no frame uses",
            )
        self._render_client_of(session).drop(session.shared.pop(request.slot))

    def free(self, session: Session) -> None:
        """Free all slots of a session."""
        for slot in session.shared.values():
            self._render_client_of(session).drop(slot)
        session.shared, session.slots_in_use = {}, set()
