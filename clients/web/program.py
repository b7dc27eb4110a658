"""`ocufilter web`: an interactive page in the browser."""

import ipaddress
import logging
import secrets
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from filter_service.command_line import Json, print_json, print_line
from filter_service.log_lines import configure_logging

DEFAULT_PORT = 8765
TOKEN_BYTES = 24
EXPOSED = (
    "web: other machines can reach this page over unencrypted HTTP; anyone who can "
    "read the traffic can use the token"
)


def read_profile(source: str | None) -> tuple[Mapping[str, Any], str] | None:
    """Return a profile and its name.

    Raises
    ------
    ValueError
        Names the field, the invalid value and what is allowed.
    """
    if source is None:
        return None
    from estimator import parse_profile, profile_body

    body = profile_body(source)
    parse_profile(body)
    return body, Path(source).name


def open_socket(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises
    ------
    ValueError
        Invalid port or empty host.
    OSError
        The port is in use, or the address does not belong to this machine; the message
        suggests a fix.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port is {port}; allowed: 0 to 65535")
    if not host:  # the system would listen on all addresses
        raise ValueError("--host is empty; expected an address such as 127.0.0.1")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise OSError(
            f"{host} port {port}: {error.strerror or error}; "
            "--port 0 selects a free one"
        ) from None


def address_of(host: str, port: int, token: str) -> str:
    """Return the address to open."""
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
        host, host
    )
    if ":" in shown:
        shown = f"[{shown}]"
    return f"http://{shown}:{port}/?token={token}"


def hosts_of(listening: socket.socket, names: Sequence[str]) -> set[str] | None:
    """Return the allowed host names of requests; None if any is allowed.

    A page reachable from this machine only has few names. A page reachable from others
    may have any name, and there only the cookie keeps out other sites' pages.
    """
    address = listening.getsockname()[0]
    if not ipaddress.ip_address(address).is_loopback:
        return None
    return {"localhost", "127.0.0.1", "::1", address, *map(str.lower, names)}


def web(
    port: Annotated[
        int, typer.Option(help="Port; 0 selects a free one.")
    ] = DEFAULT_PORT,
    host: Annotated[
        str,
        typer.Option(
            help="Address to listen on; with 0.0.0.0 or a network address, other "
            "machines can connect with the token, unencrypted."
        ),
    ] = "127.0.0.1",
    proxy_host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST",
            help="Host name in requests from a proxy on this machine; repeatable.  "
            "Without --host, only requests for localhost and these names are "
            "accepted.  The cookie is Secure if the proxy sends X-Forwarded-Proto: "
            "https.",
        ),
    ] = None,
    no_browser: Annotated[
        bool,
        typer.Option(
            "--no-browser", help="Print the address without opening a browser."
        ),
    ] = False,
    profile: Annotated[
        str | None,
        typer.Option(
            metavar="P",
            help="Initial profile of both eyes: preset name, or a .json, .abp, .csv or "
            ".zmx file.",
        ),
    ] = None,
    json_output: Json = False,
) -> None:
    """Serve a web page with an eye's data, sliders, and before-and-after views.

    Prints an address that contains an access token.  Only this machine can connect,
    unless --host is given.

    ocufilter web --profile myopia

    ocufilter web --port 8080 --no-browser
    """
    shown = read_profile(profile)
    proxy_hosts = proxy_host or []
    listening = open_socket(host, port)
    port = listening.getsockname()[1]
    hosts = hosts_of(listening, proxy_hosts)
    if hosts is None:
        sys.stderr.write(f"{EXPOSED}\n")
    token, one_time_token = (secrets.token_urlsafe(TOKEN_BYTES) for _ in range(2))
    from clients.web.server import make_server

    def announce() -> None:
        address = address_of(host, port, token)
        if json_output:
            print_json({"address": address})
        else:
            print_line(f"Open {address}\nPress Ctrl-C to stop.")
        sys.stdout.flush()
        if not no_browser:  # may wait for the browser
            one_time = address_of(host, port, one_time_token)
            threading.Thread(
                target=webbrowser.open, args=[one_time], daemon=True
            ).start()

    configure_logging("web", level=logging.WARNING)
    server = make_server(
        token,
        port,
        shown,
        one_time_token=None if no_browser else one_time_token,
        hosts=hosts,
        is_behind_proxy=bool(proxy_hosts),
        on_ready=announce,
    )
    # the server shuts down by itself and raises the signal again: exit cleanly
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    server.run(sockets=[listening])
