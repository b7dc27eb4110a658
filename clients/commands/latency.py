"""`ocufilter latency`: time frames through a running service, and their error."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from clients.commands.console import CommandFailed, Json, print_json, print_line
from clients.commands.setting_options import with_setting_options
from clients.commands.status import Seconds

DEFAULT_PROFILE = '{"kind": "prescription", "eye_side": "OS", "sphere_dpt": -2}'
RATE_LIMITS_HZ = (0.1, 1000.0)
DEFAULT_RATE_HZ = 30.0
MAX_CASES = 100
TRANSPORTS = ("auto", "tcp", "shared-memory")


@with_setting_options()
def latency(
    endpoint: Annotated[
        str, typer.Argument(metavar="ENDPOINT", help="Endpoint of the service.")
    ] = "tcp://127.0.0.1:5577",
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
            help="Also measure frames of two views, each of which has its own eye and "
            "the field of view of a headset.",
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
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Key file of the client.")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Plot the distribution of the times."),
    ] = None,
    timeout_s: Seconds = 3.0,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Time frames through a running service, and compute the error of what returns.

    Frames are sent at a fixed rate, each with another pupil and focus, and their ages
    count from that schedule.  Prints the median, the 90th and 99th percentile and the
    maximum of the round trip, the ages and each stage; the frames that were dropped;
    the time from a change of the profile to its first frame; and, computed afterward
    on this machine, the PSNR to exact frames.

    ocufilter latency tcp://127.0.0.1:5577 --size 640x360 --size 1280x720
    """
    from itertools import product

    from clients.arguments import read_profile, read_size_px
    from clients.latency import report
    from clients.latency.measure import Case, Target, compare, measure
    from clients.option_values import check_range
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
        replace_atomically(plot, lambda path: report.save_plot(results, path))
    if json_output:
        print_json(report.as_json(target, results))
        return
    for line in report.as_text(target, results):
        print_line(line)
