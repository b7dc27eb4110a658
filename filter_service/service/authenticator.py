"""The ZAP handler (ZeroMQ RFC 27): numbers connections and checks their keys."""

from __future__ import annotations

import logging
from collections.abc import Callable

import zmq
from zmq.utils import z85

from filter_service.keys import KeyRing

ENDPOINT = "inproc://zeromq.zap.01"
VERSION = b"1.0"
DOMAIN = b"ocufilter"
MAX_REQUESTS_PER_TURN = 64

log = logging.getLogger("ocufilter")


class Authenticator:
    """ZAP handler that numbers connections and admits only those with an allowed key.

    Parameters
    ----------
    context : zmq.Context
        Context of the secured socket, which must be bound after this handler exists.
    keys : KeyRing, optional
        Allowed keys; if None, every connection is admitted.
    on_request : callable
        Called when a connection requests admission, before it is numbered; by then the
        socket's monitor has reported that the connection was accepted.

    Attributes
    ----------
    next_number : int
        Number of the next connection that is admitted.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keys: KeyRing | None,
        on_request: Callable[[], None],
    ) -> None:
        self._keys, self._on_request = keys, on_request
        self.next_number = 1
        self.socket = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind(ENDPOINT)

    def secure(self, socket: zmq.Socket[bytes]) -> None:
        """Enable authentication on a socket that is not bound yet."""
        socket.zap_domain = DOMAIN
        if self._keys is not None:
            pair = self._keys.server
            socket.curve_server = True
            socket.curve_secretkey = pair.secret.encode()
            socket.curve_publickey = pair.public.encode()

    def handle_requests(self) -> None:
        """Reply to pending ZAP requests."""
        for _ in range(MAX_REQUESTS_PER_TURN):
            try:
                request = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._on_request()
            self.socket.send_multipart(self._reply(request))

    def accepts(self, key: str) -> bool:
        """Return whether a client's public key is currently allowed."""
        return self._keys is None or key in self._keys.allowed()

    def _reply(self, request: list[bytes]) -> list[bytes]:
        _, request_id, _, address, _, mechanism, *credentials = request
        key = ""
        if self._keys is not None:
            key = z85.encode(credentials[0]).decode() if credentials else ""
            if mechanism != b"CURVE" or not self.accepts(key):
                log.warning(
                    "rejected a client at %s: its key is not allowed", address.decode()
                )
                return [*(VERSION, request_id, b"400", b"key is not allowed", b"", b"")]
        user_id = f"{self.next_number} {key}".strip()
        self.next_number += 1
        return [VERSION, request_id, b"200", b"OK", user_id.encode(), b""]

    def close(self) -> None:
        """Close the socket."""
        self.socket.close(linger=0)


def parse_user_id(user_id: str) -> tuple[int, str]:
    """Return a connection's number and key, parsed from its ``User-Id``."""
    number, _, key = user_id.partition(" ")
    return int(number), key
