"""Who may connect: answers libzmq's questions about keys (ZAP, ZeroMQ RFC 27)."""

from __future__ import annotations

import logging

import zmq
from zmq.utils import z85

from filter_service.keys import KeyRing

ENDPOINT = "inproc://zeromq.zap.01"
VERSION = b"1.0"

log = logging.getLogger("ocufilter")


class Gate:
    """Lets in the clients of a key ring and nobody else.

    Parameters
    ----------
    context : zmq.Context
        Of the socket that is guarded; the gate is to be opened before that is bound.
    keys : KeyRing
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], keys: KeyRing) -> None:
        self._keys = keys
        self.n_refused = 0
        self.socket = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind(ENDPOINT)

    def guard(self, socket: zmq.Socket[bytes]) -> None:
        """Have a socket speak with nothing but keys."""
        pair = self._keys.server
        socket.curve_server = True
        socket.curve_secretkey = pair.secret.encode()
        socket.curve_publickey = pair.public.encode()
        socket.zap_domain = b"ocufilter"

    def answer(self) -> None:
        """Answer the questions that wait."""
        while True:
            try:
                question = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self.socket.send_multipart(self._reply(question))

    def lets_in(self, key: str) -> bool:
        """Return whether a key is still allowed."""
        return key in self._keys.allowed()

    def _reply(self, question: list[bytes]) -> list[bytes]:
        _, number, _, address, _, mechanism, *credentials = question
        key = z85.encode(credentials[0]).decode() if credentials else ""
        if mechanism == b"CURVE" and self.lets_in(key):
            return [VERSION, number, b"200", b"OK", key.encode(), b""]
        self.n_refused += 1
        log.warning("a client at %s has no key that is allowed", address.decode())
        return [VERSION, number, b"400", b"no key that is allowed", b"", b""]

    def close(self) -> None:
        """Close it."""
        self.socket.close(linger=0)
