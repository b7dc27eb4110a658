"""Shared memory for the images of clients on this machine."""

from __future__ import annotations

from collections.abc import Callable

from filter_service.errors import BadMessage, OutOfMemory
from filter_service.messages import Share, Shared, Unshare
from filter_service.service.config import LOOPBACK_HOSTS, ServiceConfig
from filter_service.service.render_client import RenderClient
from filter_service.service.session import Session

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
