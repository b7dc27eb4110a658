"""The socket that the service listens on, made here where the system can do more."""

from __future__ import annotations

import socket
from pathlib import Path

# Longer than libzmq's 100, so that the first packet of a client is not lost where many
# connect at once: the system sends it again only after a second.
BACKLOG = 4096
DEFER_ACCEPT_S = 5
"""TCP connections that say nothing wait in the kernel for so long or somewhat longer; a
client of ZeroMQ speaks first.  1,500 of them that come again and again then cost at
most 200 accepted connections a second instead of 5,000."""

TCP_DEFER_ACCEPT: int | None = getattr(socket, "TCP_DEFER_ACCEPT", None)


def check_path_is_free(bind: str) -> None:
    """Refuse an ``ipc://`` path that holds a file or a live endpoint.

    Binding removes whatever is at the path; only a dead socket may go that way.
    """
    if not bind.startswith("ipc://"):
        return
    path = Path(bind.removeprefix("ipc://"))
    if not path.exists():
        return
    if not path.is_socket():
        raise FileExistsError(f"{path} is there already and is no socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return
    raise FileExistsError(f"another service listens on {path}")


def socket_family(bind: str) -> socket.AddressFamily:
    """Return of what kind the connections of an endpoint are."""
    if bind.startswith("ipc://"):
        return socket.AF_UNIX
    return socket.AF_INET6 if bind.startswith("tcp://[") else socket.AF_INET


def deferring_listener(bind: str) -> socket.socket | None:
    """Return a TCP socket that shows connections once their clients have spoken.

    None for other transports, and for names that only libzmq knows, of interfaces.

    Raises
    ------
    OSError
        The address is taken, or is none of this machine.
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
