"""A page in people's hands: `ocufilter web`.

    ocufilter web
    ocufilter web --profile myopia --port 8080 --no-browser

Serves this machine alone, with a token in the address that it prints.
"""

from __future__ import annotations

import argparse
import json
import secrets
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clients.extra import WEB_INSTALL

DEFAULT_PORT = 8765
TOKEN_BYTES = 24


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter web",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help=f"0 takes a free one (default: {DEFAULT_PORT})",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve; others than the default let other machines in, "
        "unencrypted, with the token (default: 127.0.0.1)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="print the address and open nothing"
    )
    parser.add_argument(
        "--profile",
        metavar="P",
        help="both eyes at first: a preset's name, or a .json, .abp or .csv file",
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
        Names the field, the bad value and what is allowed.
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
        A port that is none.
    OSError
        It is taken, or the address is not this machine's: says what helps.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port is {port}; allowed: 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise OSError(
            f"{host} port {port}: {error.strerror or error}; --port 0 takes a free one"
        ) from None


def address_of(host: str, port: int, token: str) -> str:
    """Return the address to open."""
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
        host, host
    )
    if ":" in shown:
        shown = f"[{shown}]"
    return f"http://{shown}:{port}/?token={token}"


def serve(options: argparse.Namespace) -> int:
    """Serve until the end; return the exit code."""
    profile = read_profile(options.profile)
    listening = open_socket(options.host, options.port)
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(TOKEN_BYTES)
    from clients.web.server import make_server

    address = address_of(options.host, port, token)
    server = make_server(token, port, profile, on_ready=lambda: _tell(address, options))
    # the server stops by itself, then hands the signal on: to an orderly end
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    server.run(sockets=[listening])
    return 0


def _tell(address: str, options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps({"address": address}), flush=True)
    else:
        print(f"Open {address}\nCtrl-C ends it.", flush=True)
    if not options.no_browser:  # may wait for the browser
        threading.Thread(target=webbrowser.open, args=[address], daemon=True).start()


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
