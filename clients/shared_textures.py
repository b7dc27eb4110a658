"""Textures that a client shares with a service on the same machine.

The client exports memory, with Vulkan, and sends its descriptor over a socket that the
service names in its welcome message.
"""

from __future__ import annotations

import logging
import socket

from filter_service.messages import (
    SharedTexture,
    ShareTexture,
    TextureOffer,
    encode,
)

SEND_LIMIT_S = 1.0
REPLY_LIMIT_S = 5.0
"""Longest wait for an import; a service of another user ignores the descriptor."""

log = logging.getLogger("ocufilter")


class SharedTextures:
    """Shared textures of one session."""

    def __init__(self) -> None:
        self.offer: TextureOffer | None = None
        self._next_number = 1
        self._reasons: dict[int, str] = {}  # of the replies, by texture
        self._reported = ""

    def begin(self, offer: TextureOffer | None) -> None:
        """Forget the textures of the previous connection, which the service freed."""
        self.offer = offer
        self._reasons = {}

    def new_number(self) -> int:
        """Return a number for a new texture."""
        self._next_number += 1
        return self._next_number - 1

    def refusal(self, device_uuid: str | None) -> str:
        """Return why the service cannot import a texture, or an empty string."""
        if self.offer is None:
            return "the service does not offer them to this client"
        if device_uuid is not None and device_uuid not in self.offer.device_uuids:
            devices = ", ".join(self.offer.device_uuids)
            return f"memory of device {device_uuid}; the service uses {devices}"
        return ""

    def send(self, request: ShareTexture, descriptor: int) -> str:
        """Send a descriptor; return why that failed, or an empty string."""
        assert self.offer is not None
        self._reasons.pop(request.texture, None)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(SEND_LIMIT_S)
            try:
                sender.connect(f"\0{self.offer.socket}")
                socket.send_fds(sender, encode(request), [descriptor])
            except OSError as error:  # another machine or network namespace
                return str(error)
        return ""

    def take_in(self, reply: SharedTexture) -> None:
        """Record whether the service has a texture."""
        self._reasons[reply.texture] = reply.reason

    def reply_about(self, number: int) -> SharedTexture | None:
        """Return the service's reply about a texture."""
        reason = self._reasons.get(number)
        return None if reason is None else SharedTexture(number, reason)

    def report(self, reason: str) -> None:
        """Log why textures are not shared, once."""
        if reason != self._reported:
            self._reported = reason
            log.warning("no shared textures, send images instead: %s", reason)
