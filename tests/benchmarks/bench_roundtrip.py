"""Latency of pre-rendered frames through a service, on a fixed schedule.

    ocufilter bench roundtrip --spawn --size 1280x720 --rate-hz 30 --seconds 10
    ocufilter bench roundtrip --endpoint tcp://127.0.0.1:5577 --json out.json

The schedule is open-loop: a frame's due time does not depend on earlier replies, and
ages count from it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from clients.commands.options import read_object, read_profile, read_size_px
from clients.filter_client import FilterClient
from clients.latency.stream import LatencyRun, StreamSettings, measure_stream
from clients.service_process import ServiceProcess
from filter_service.errors import FilterError
from filter_service.keys import KeyRing
from filter_service.messages import COMPRESSIONS, DEPTH_ENCODINGS
from tests.benchmarks.roundtrip_report import as_json, as_table, save_plot, summary
from tests.benchmarks.socket_floor import socket_floor_ms

TRANSPORTS = ("tcp", "ipc", "shm", "curve")
DEFAULT_PROFILE = '{"kind": "prescription", "eye_side": "OS", "sphere_dpt": -2}'
DEFAULT_RIGHT_PROFILE = (
    '{"kind": "prescription", "eye_side": "OD", "sphere_dpt": -3, "cylinder_dpt": -1, '
    '"axis_deg": 20}'
)
STDOUT = "-"


@contextlib.contextmanager
def connect(
    endpoint: str | None, settings: StreamSettings, key_file: Path | None = None
) -> Iterator[tuple]:
    """Yield (client, reader of the service's memory); start a service if needed."""
    with contextlib.ExitStack() as stack:
        service, transport = None, settings.transport
        if endpoint is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            how = {}
            if transport in ("ipc", "shm"):
                how = {"bind": f"ipc://{folder}/service"}
            elif transport == "curve":
                key_file, keys = folder / "key.toml", KeyRing(folder / "keys")
                keys.add("benchmark", key_file)
                how = {"keys_dir": str(keys.folder)}
            service = stack.enter_context(ServiceProcess(how))
            endpoint = service.endpoint
        client = stack.enter_context(
            FilterClient(
                endpoint,
                max_in_flight=settings.max_in_flight,
                client_name="latency benchmark",
                shared_memory=transport == "shm",
                key_file=key_file,
                compression=settings.compression,
            )
        )
        if transport == "shm" and "shm" not in client.hello().transports:
            raise ValueError(f"{endpoint} shares no memory")
        if service is not None:
            yield client, lambda: service.memory_mb
        else:
            yield client, lambda: client.ping(timeout_s=30)[1].memory_mb


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter bench roundtrip",
        description=__doc__.splitlines()[0],
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--endpoint", help="a running service")
    parser.add_argument("--key", type=Path, metavar="FILE", help="for --endpoint")
    where.add_argument("--spawn", action="store_true", help="start a service (default)")
    parser.add_argument(
        "--transport",
        choices=TRANSPORTS,
        default="tcp",
        help="tcp, ipc, or shared memory beside it, or tcp with encryption; of the "
        "service that is started",
    )
    parser.add_argument(
        "--compression", choices=COMPRESSIONS, default="none", help="of what is sent"
    )
    parser.add_argument(
        "--depth", choices=DEPTH_ENCODINGS, default="float32", help="as it travels"
    )
    parser.add_argument("--size", help="WxH in px (1280x720; stereo 1832x1920)")
    parser.add_argument("--views", type=int, default=1, help="1, or 2 for stereo")
    parser.add_argument(
        "--stereo",
        action="store_true",
        help="a headset: 2 x 1832x1920, asymmetric, each eye with a profile of its own",
    )
    parser.add_argument("--rate-hz", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument(
        "--profile",
        default=DEFAULT_PROFILE,
        help="preset, JSON, or a .json, .abp or .csv file",
    )
    parser.add_argument(
        "--right-profile",
        default=DEFAULT_RIGHT_PROFILE,
        help="of the right eye with --stereo; --profile is then the left one's",
    )
    parser.add_argument(
        "--settings",
        default="{}",
        help='JSON with a profile\'s settings, as {"pupil_range_mm": [3, 5]}',
    )
    parser.add_argument("--pupil-mm", type=float, default=4.0)
    parser.add_argument("--focus-dpt", type=float, default=0.0)
    parser.add_argument("--output", choices=("srgb8", "linear"), default="srgb8")
    parser.add_argument("--in-flight", type=int, default=1)
    parser.add_argument(
        "--json",
        nargs="?",
        const=STDOUT,
        metavar="OUT",
        help="write JSON to a file, or to stdout and nothing else there",
    )
    parser.add_argument("--plot", type=Path, metavar="OUT.png")
    parser.add_argument("--quick", action="store_true", help="320x180 for 3 s")
    return parser.parse_args(arguments)


def read_settings(arguments: argparse.Namespace) -> StreamSettings:
    """Return the settings of a command line.

    Raises
    ------
    ValueError
        If a value is invalid; the message names the option.
    """
    usual = "1832x1920" if arguments.stereo else "1280x720"
    size = "320x180" if arguments.quick else arguments.size or usual
    width_px, height_px = read_size_px(size)
    if not 0 < arguments.rate_hz <= 1000:
        raise ValueError(f"--rate-hz is {arguments.rate_hz:g}; allowed: up to 1000")
    if not arguments.seconds > 0:
        raise ValueError(f"--seconds is {arguments.seconds:g}; allowed: above 0")
    return StreamSettings(
        width_px=width_px,
        height_px=height_px,
        n_views=2 if arguments.stereo else arguments.views,
        transport=arguments.transport,
        compression=arguments.compression,
        depth_encoding=arguments.depth,
        rate_hz=arguments.rate_hz,
        duration_s=3.0 if arguments.quick else arguments.seconds,
        profile=read_profile(arguments.profile),
        right_profile=(
            read_profile(arguments.right_profile) if arguments.stereo else None
        ),
        profile_settings=read_object("--settings", arguments.settings),
        pupil_diameter_mm=arguments.pupil_mm,
        focus_dpt=arguments.focus_dpt,
        output=arguments.output,
        max_in_flight=arguments.in_flight,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    parsed = parse_arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        settings = read_settings(parsed)
        with connect(parsed.endpoint, settings, parsed.key) as (client, memory):
            run = measure_stream(client, settings, memory)
        carrier = "tcp" if settings.transport in ("tcp", "curve") else "ipc"
        run.floor_ms = socket_floor_ms(carrier, *run.n_bytes_per_frame)
    except ValueError as error:
        print(f"latency: {error}", file=sys.stderr)
        return 2
    except (FilterError, OSError, RuntimeError) as error:
        print(f"latency: {error}", file=sys.stderr)
        return 1
    if run.n_filtered == 0:
        print(f"latency: no frame was filtered: {dict(run.drops)}", file=sys.stderr)
        return 1
    report(run, parsed)
    return 0


def report(run: LatencyRun, parsed: argparse.Namespace) -> None:
    """Print or write the table, JSON and plot as requested."""
    console = Console(stderr=parsed.json == STDOUT)
    console.print(as_table(run))
    console.print(summary(run), highlight=False)
    if parsed.plot is not None:
        save_plot(run, parsed.plot)
    if parsed.json == STDOUT:
        print(json.dumps(as_json(run)))
    elif parsed.json is not None:
        path = Path(parsed.json)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(as_json(run), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
