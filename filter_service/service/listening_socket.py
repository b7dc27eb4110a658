"""The listening socket, with TCP options that libzmq does not set."""

from __future__ import annotations

import socket
from pathlib import Path

BACKLOG = 4096
"""Larger than libzmq's 100: when many clients connect at once, a full backlog loses
their first packets, which the system resends only after a second."""

DEFER_ACCEPT_S = 5
"""Minimum time for which the kernel holds back TCP connections that have sent no data;
a ZeroMQ client sends first.  1,500 silent clients that keep reconnecting then cause at
most 200 accepted connections per second instead of 5,000."""

TCP_DEFER_ACCEPT: int | None = getattr(socket, "TCP_DEFER_ACCEPT", None)


def check_path_is_free(bind: str) -> None:
    """Check that an ``ipc://`` path is free or a stale socket, which binding replaces.

    Raises
    ------
    FileExistsError
        If it is another file, or a service listens on it.
    """
    if not bind.startswith("ipc://"):
        return
    path = Path(bind.removeprefix("ipc://"))
    if not path.exists():
        return
    if not path.is_socket():
        raise FileExistsError(f"{path} exists and is not a socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return
    raise FileExistsError(f"another service listens on {path}")


def socket_family(bind: str) -> socket.AddressFamily:
    """Return the address family of an endpoint's connections."""
    if bind.startswith("ipc://"):
        return socket.AF_UNIX
    return socket.AF_INET6 if bind.startswith("tcp://[") else socket.AF_INET


def deferring_listener(bind: str) -> socket.socket | None:
    """Return a TCP socket that accepts connections once their clients have sent data.

    Return None for other transports, and for interface names, which libzmq resolves.

    Raises
    ------
    OSError
        If the address is in use, or is not one of this machine.
    """
    if not bind.startswith("tcp://") or TCP_DEFER_ACCEPT is None:
        return None
    host, _, port = bind.removeprefix("tcp://").rpartition(":")
    family = socket_family(bind)
    wildcard = "::" if family == socket.AF_INET6 else "0.0.0.0"
    name = wildcard if host == "*" else host.strip("[]")
    number = 0 if port == "*" else int(port)
    try:
        found = socket.getaddrinfo(name, number, family, socket.SOCK_STREAM)
    except socket.gaierror:
        return None
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.IPPROTO_TCP, TCP_DEFER_ACCEPT, DEFER_ACCEPT_S)
        listener.bind(found[0][4])
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener
