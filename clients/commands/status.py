"""`ocufilter status`: print the state of a running service."""

from pathlib import Path
from typing import Annotated, Any

import typer

from clients.commands.console import Json, print_json

Seconds = Annotated[float, typer.Option("--timeout", metavar="S", help="Timeout, s.")]


def status(
    endpoint: Annotated[
        str, typer.Argument(metavar="ENDPOINT", help="Endpoint of the service.")
    ] = "tcp://127.0.0.1:5577",
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Key file of the client.")
    ] = None,
    timeout_s: Seconds = 3.0,
    json_output: Json = False,
) -> None:
    """Print the state of a service; the exit code is 0 if it responds.

    A ready service filters frames.  A service that is alive but not ready is starting
    or restarting its render process.

    ocufilter status tcp://127.0.0.1:5577
    """
    from filter_service.service.status_query import query_status

    found = query_status(endpoint, key_file=key, timeout_s=timeout_s)
    if json_output:
        print_json(found)
        return
    state = "ready" if found["is_ready"] else "alive, not ready"
    if found["is_degraded"]:
        state += ", degraded: a process ends repeatedly; see the service's log"
    print(f"{endpoint} is {state}")
    for name in ("n_connections", "n_sessions", "n_rendered", "n_dropped", "memory_mb"):
        print(f"  {name:<16} {found[name]:g}")
    for name in ("is_filtering", "is_building"):
        print(f"  {name:<16} {'yes' if found[name] else 'no'}")
    print(f"  {'render_silent_s':<16} {found['render_silent_s']:.2f}")
    for index, device in enumerate(found["devices"]):
        print(f"  {f'device {index}':<16} {_describe_device(device)}")


def _describe_device(device: dict[str, Any]) -> str:
    """Return one line with the name, state and load of a device."""
    is_ready = "ready" if device["is_ready"] else "not ready"
    if device["is_lost"]:
        is_ready = "lost"
    return (
        f"{device['name']}: {device['renderer'] or 'unknown renderer'}, {is_ready}, "
        f"{device['n_sessions']} sessions, busy {device['busy_ratio']:.0%}, "
        f"{device['n_rendered']} frames, {device['memory_mb']:.0f} MB"
    )
