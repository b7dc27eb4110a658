"""Interactive page in the browser: `ocufilter web`.

    ocufilter web
    ocufilter web --profile myopia --port 8080 --no-browser

Prints an address that contains an access token.  Only this machine can connect, unless
`--host` is given.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import logging
import secrets
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from clients.extra import WEB_INSTALL
from filter_service.log_lines import configure_logging

DEFAULT_PORT = 8765
TOKEN_BYTES = 24
EXPOSED = (
    "web: other machines can reach this page over unencrypted HTTP; anyone who can "
    "read the traffic can use the token"
)


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter web",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help=f"port; 0 selects a free one (default: {DEFAULT_PORT})",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; with 0.0.0.0 or a network address, other machines "
        "can connect with the token, unencrypted (default: 127.0.0.1)",
    )
    parser.add_argument(
        "--proxy-host",
        action="append",
        default=[],
        metavar="HOST",
        help="host name in requests from a proxy on this machine; may be repeated.  "
        "Without --host, only requests for localhost and these names are accepted.  "
        "The cookie is Secure if the proxy sends X-Forwarded-Proto: https",
    )
    parser.add_argument(
        "--no-browser",
        action="store_true",
        help="print the address without opening a browser",
    )
    parser.add_argument(
        "--profile",
        metavar="P",
        help="initial profile of both eyes: preset name, or a .json, .abp, .csv or "
        ".zmx file",
    )
    parser.add_argument(
        "--json", action="store_true", help="print the address as a JSON object"
    )
    return parser.parse_args(argv)


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


def serve(options: argparse.Namespace) -> int:
    """Serve until interrupted; return the exit code."""
    profile = read_profile(options.profile)
    listening = open_socket(options.host, options.port)
    port = listening.getsockname()[1]
    hosts = hosts_of(listening, options.proxy_host)
    if hosts is None:
        print(EXPOSED, file=sys.stderr, flush=True)
    token, one_time_token = (secrets.token_urlsafe(TOKEN_BYTES) for _ in range(2))
    from clients.web.server import make_server

    configure_logging("web", level=logging.WARNING)
    addresses = [address_of(options.host, port, t) for t in (token, one_time_token)]
    server = make_server(
        token,
        port,
        profile,
        one_time_token=None if options.no_browser else one_time_token,
        hosts=hosts,
        is_behind_proxy=bool(options.proxy_host),
        on_ready=lambda: _announce(*cast(tuple[str, str], addresses), options),
    )
    # the server shuts down by itself and raises the signal again: exit cleanly
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    server.run(sockets=[listening])
    return 0


def _announce(address: str, one_time_address: str, options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps({"address": address}), flush=True)
    else:
        print(f"Open {address}\nPress Ctrl-C to stop.", flush=True)
    if not options.no_browser:  # may wait for the browser
        threading.Thread(
            target=webbrowser.open, args=[one_time_address], daemon=True
        ).start()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    options = arguments_of(argv)
    try:
        return serve(options)
    except ModuleNotFoundError as error:
        print(f"web: {error.name} is not installed: {WEB_INSTALL}", file=sys.stderr)
        return 1
    except ValueError as error:
        print(f"web: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"web: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
