"""Status query to a running service, open to every client that can connect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import zmq

from filter_service.errors import ServiceTimeout
from filter_service.keys import load_client_key
from filter_service.messages import Ping, Pong, decode_reply, encode


def query_status(
    endpoint: str, *, key_file: Path | None = None, timeout_s: float = 3.0
) -> dict[str, Any]:
    """Ping a service and return the fields of its reply.

    Parameters
    ----------
    endpoint : str
    key_file : Path, optional
        Key file of a client; required if the service has keys.
    timeout_s : float

    Raises
    ------
    ServiceTimeout
        If the service does not answer in time.
    ValueError
        If the endpoint or the key file is invalid.
    """
    key = None if key_file is None else load_client_key(key_file)
    context = zmq.Context()
    socket = context.socket(zmq.DEALER)
    try:
        socket.linger = 0
        if key is not None:
            key.use_on(socket)
        socket.rcvtimeo = socket.sndtimeo = round(1000 * timeout_s)
        socket.connect(endpoint)
        socket.send_multipart(encode(Ping(0.0)))
        pong = decode_reply(socket.recv_multipart())
    except zmq.Again:
        raise ServiceTimeout(
            f"no reply from {endpoint} within {timeout_s:g} s"
            + (" (a service with keys answers only with --key FILE)" if not key else "")
        ) from None
    except zmq.ZMQError as error:
        raise ValueError(f"endpoint is {endpoint!r}: {error}") from None
    finally:
        socket.close(linger=0)
        context.term()
    if not isinstance(pong, Pong):
        raise ValueError(f"{endpoint} answers a ping with {pong.type_name}")
    return {"endpoint": endpoint, "is_alive": True} | pong.fields()
