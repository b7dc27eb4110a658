"""`ocufilter status`, `latency`, `keys` and `eyes`: use and administer a service."""

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clients.commands.options import with_setting_options
from filter_service.building.jobs import CACHE_VARIABLE
from filter_service.command_line import (
    CommandFailed,
    Json,
    check_range,
    print_json,
    print_line,
    typer_app,
)

if TYPE_CHECKING:
    from filter_service.keys import KeyRing

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5577"
Endpoint = Annotated[
    str, typer.Argument(metavar="ENDPOINT", help="Endpoint of the service.")
]
Key = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Key file of the client.")
]
Seconds = Annotated[
    float, typer.Option("--timeout", metavar="S", help="Longest wait for a reply, s.")
]


def status(
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    key: Key = None,
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


DEFAULT_PROFILE = '{"kind": "prescription", "eye_side": "OS", "sphere_dpt": -2}'
RATE_LIMITS_HZ = (0.1, 1000.0)
DEFAULT_RATE_HZ = 30.0
MAX_CASES = 100
TRANSPORTS = ("auto", "tcp", "shared-memory")


@with_setting_options()
def latency(
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    transport: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(TRANSPORTS),
            help="Images in shared memory, or in the messages to the endpoint (tcp); "
            "auto: shared memory if the service offers it.  Repeatable, as are --size "
            "and --rate-hz; each combination is measured.",
        ),
    ] = None,
    size: Annotated[
        list[str] | None,
        typer.Option(metavar="WxH", help="Size of a view in px; by default 640x360."),
    ] = None,
    rate_hz: Annotated[
        list[float] | None,
        typer.Option(
            "--rate-hz",
            "--rate",
            metavar="HZ",
            help="Frames per second; by default 30.",
        ),
    ] = None,
    stereo: Annotated[
        bool,
        typer.Option(
            "--stereo",
            help="Also measure frames of two views, each with its own eye and a "
            "headset's field of view.",
        ),
    ] = False,
    frames: Annotated[
        int, typer.Option(min=1, max=100_000, help="Frames to measure in each case.")
    ] = 100,
    still: Annotated[
        bool,
        typer.Option(
            "--still", help="Same pupil (4 mm) and focus (0 dpt) in every frame."
        ),
    ] = False,
    profile: Annotated[
        str,
        typer.Option(help="Preset name, JSON, or a .json, .abp, .csv or .zmx profile."),
    ] = DEFAULT_PROFILE,
    key: Key = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Plot the distribution of the times."),
    ] = None,
    timeout_s: Seconds = 3.0,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Time frames through a running service, and compute the error of the images.

    Frames are sent at a fixed rate, each with a different pupil and focus, and their
    ages are relative to that schedule.  Prints the median, the 90th and 99th percentile
    and the maximum of the round trip, the ages and each stage; the frames that were
    dropped; the time from a change of the profile to its first frame; and, computed
    afterward on this machine, the PSNR to exact frames.

    ocufilter latency tcp://127.0.0.1:5577 --size 640x360 --size 1280x720
    """
    from itertools import product

    from clients.commands.options import read_profile, read_size_px
    from clients.latency.measure import (
        Case,
        Target,
        as_json,
        as_text,
        compare,
        measure,
        save_plot,
    )
    from filter_service.atomic_files import replace_atomically
    from filter_service.errors import FilterError
    from filter_service.image_files import check_output

    ways = transport or ["auto"]
    for way in ways:
        if way not in TRANSPORTS:
            raise ValueError(
                f"--transport is {way!r}; allowed: {', '.join(TRANSPORTS)}"
            )
    sizes_px = [read_size_px(text) for text in size or ["640x360"]]
    rates_hz = rate_hz or [DEFAULT_RATE_HZ]
    for rate in rates_hz:
        check_range("--rate-hz", rate, RATE_LIMITS_HZ)
    if plot is not None:
        check_output(plot, (".png",))
    cases = [
        Case(way, size_px, n_views, rate)
        for way, n_views, size_px, rate in product(
            ways, (1, 2) if stereo else (1,), sizes_px, rates_hz
        )
    ]
    if len(cases) > MAX_CASES:
        raise ValueError(f"{len(cases)} combinations; allowed: at most {MAX_CASES}")
    target = Target(
        endpoint=endpoint,
        key_file=key,
        timeout_s=timeout_s,
        profile=read_profile(profile),
        profile_settings=settings,
        n_frames=frames,
        is_moving=not still,
    )
    results = []
    for number, case in enumerate(cases, 1):
        results.append(measure(target, case))
        if not json_output and len(cases) > 1:
            sys.stderr.write(f"measured {number} of {len(cases)} cases\n")
    if not any(found.run.n_filtered for found in results):
        drops = dict(results[0].run.drops)
        raise CommandFailed(f"{endpoint} filtered no frame; dropped: {drops}")
    try:
        compare(target, results)
    except FilterError as failure:  # the times remain
        sys.stderr.write(f"ocufilter: the error is missing: {failure}\n")
    if plot is not None:
        replace_atomically(plot, lambda path: save_plot(results, path))
    if json_output:
        print_json(as_json(target, results))
        return
    for line in as_text(target, results):
        print_line(line)


KeyFolder = Annotated[
    Path | None,
    typer.Option(
        "--dir",
        metavar="DIR",
        help="Key folder; by default ocufilter/keys in $XDG_CONFIG_HOME.",
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Client name.")]

keys = typer_app(
    help="Create and revoke client keys, for a service that accepts other machines.",
    no_args_is_help=True,
)


def default_folder() -> Path:
    """Return the default key folder."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "ocufilter" / "keys"


def _ring(folder: Path | None) -> "KeyRing":
    from filter_service.keys import KeyRing

    return KeyRing(folder or default_folder())


@keys.command()
def add(
    name: Name,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Key file to write; by default NAME.toml."),
    ] = None,
    folder: KeyFolder = None,
    json_output: Json = False,
) -> None:
    """Authorize a client and write the key file that it connects with.

    Send the file to the client, and only to the client, over a secure channel.  A
    service that runs with this folder (keys_dir in its configuration) accepts the key
    immediately.

    ocufilter keys add lab
    """
    ring, file = _ring(folder), out or Path(f"{name}.toml")
    key = ring.add(name, file)
    if json_output:
        print_json({"name": name, "public": key.pair.public, "file": str(file)})
        return
    print_line(
        f"{name} may connect with {file}; the service needs keys_dir = '{ring.folder}'"
    )


@keys.command()
def remove(name: Name, folder: KeyFolder = None, json_output: Json = False) -> None:
    """Remove a client's key; a connected client is disconnected.

    ocufilter keys remove lab
    """
    _ring(folder).remove(name)
    if json_output:
        print_json({"removed": name})
    else:
        print_line(f"{name} can no longer connect")


@keys.command(name="list")
def list_names(folder: KeyFolder = None, json_output: Json = False) -> None:
    """List the clients that may connect.

    ocufilter keys list
    """
    names = _ring(folder).names()
    if json_output:
        print_json({"names": names})
    else:
        print("\n".join(names) if names else "no client may connect yet")


MB = 1e6
SHOWN_CHARACTERS = 12

EyeFolder = Annotated[
    Path | None,
    typer.Option(
        "--dir",
        metavar="DIR",
        help=f"Cache folder (store_cache_dir of the service) [${CACHE_VARIABLE}].",
    ),
]

eyes = typer_app(
    help="List and erase the eyes cached on disk (`serve --keep-eyes DIR`).",
    no_args_is_help=True,
)


def _folder(given: Path | None) -> Path:
    named = given or os.environ.get(CACHE_VARIABLE)
    if not named:
        raise ValueError(
            f"no cache folder; allowed: --dir DIR, or the variable {CACHE_VARIABLE}. A "
            "service caches eyes only with store_cache_dir or serve --keep-eyes"
        )
    return Path(named).expanduser()


@eyes.command(name="list")
def list_cached(folder: EyeFolder = None, json_output: Json = False) -> None:
    """List the cached eyes by profile hash, most recently used first.

    ocufilter eyes list --dir ~/.cache/ocufilter
    """
    from filter_service.psfs.store_cache import cached_eyes

    found = cached_eyes(_folder(folder))
    if json_output:
        print_json({"eyes": [vars(eye) for eye in found]})
        return
    for eye in found:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(eye.used_s))
        print(
            f"{eye.name[:SHOWN_CHARACTERS]}  {eye.n_files:3d} files  "
            f"{eye.size_bytes / MB:8.1f} MB  used {used}"
        )
    if not found:
        print("no eyes are cached")


@eyes.command()
def erase(
    profile: Annotated[
        str | None,
        typer.Argument(
            metavar="[PROFILE]", help="Preset or file, as for `ocufilter filter`."
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(metavar="HASH", help="Hash printed by `eyes list`.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Erase all eyes.")] = False,
    folder: EyeFolder = None,
    json_output: Json = False,
) -> None:
    """Erase the cached data of one eye, by profile or by hash, or of all eyes.

    ocufilter eyes erase anna.json --dir ~/.cache/ocufilter
    """
    from filter_service.psfs.store_cache import erase_eyes

    if (profile is not None) + (name is not None) + every != 1:
        raise ValueError(
            "no eye or several selected; allowed: one of PROFILE, --name HASH and --all"
        )
    prefix = name or ""
    if profile is not None:
        from estimator.profiles.files import load_profile
        from filter_service.psfs.store_cache import eye_name

        prefix = eye_name(load_profile(profile))
    elif name is not None and (not name or name.strip("0123456789abcdef")):
        raise ValueError(f"--name is {name!r}; allowed: a hash printed by `eyes list`")
    n_files = erase_eyes(_folder(folder), prefix)
    if json_output:
        print_json({"erased_files": n_files})
    else:
        print_line(f"{n_files} files erased" if n_files else "nothing was cached")
