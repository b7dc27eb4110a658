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
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from clients.arguments import read_object, read_profile, read_size_px
from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import ServiceProcess
from filter_service import tangents_from_fov
from filter_service.errors import FilterError
from filter_service.keys import KeyRing
from filter_service.messages import (
    COMPRESSIONS,
    DEPTH_ENCODINGS,
    Compression,
    DepthEncoding,
    Dropped,
    ErrorReply,
    EyeName,
    ViewState,
)
from tests.benchmarks.roundtrip_report import (
    SERVICE_STAGES,
    LatencyRun,
    as_json,
    as_table,
    save_plot,
    summary,
)
from tests.benchmarks.socket_floor import socket_floor_ms

N_FRAMES = 8  # in the loop of frames
VERTICAL_FOV_DEG = 45.0
TRANSPORTS = ("tcp", "ipc", "shm", "curve")
DEFAULT_PROFILE = '{"kind": "prescription", "eye_side": "OS", "sphere_dpt": -2}'
DEFAULT_RIGHT_PROFILE = (
    '{"kind": "prescription", "eye_side": "OD", "sphere_dpt": -3, "cylinder_dpt": -1, '
    '"axis_deg": 20}'
)
HEADSET_EDGES_DEG = (-52.0, 42.0, 43.0, -53.0)
"""Left, right, up and down of a headset's left view; the right one's is mirrored."""

EYES: tuple[EyeName, ...] = ("left", "right")
STRAGGLER_S = 10.0
STDOUT = "-"


@dataclass(frozen=True)
class Settings:
    """Settings of a run: content and transport of the stream."""

    width_px: int
    height_px: int
    n_views: int
    rate_hz: float
    duration_s: float
    profile: dict[str, Any]
    profile_settings: dict[str, Any]
    pupil_diameter_mm: float
    focus_dpt: float
    output: str
    max_in_flight: int
    transport: str = "tcp"
    compression: Compression = "none"
    depth_encoding: DepthEncoding = "float32"
    right_profile: dict[str, Any] | None = None  # then `profile` is the left eye's

    @property
    def tangents(self) -> list[tuple[float, float, float, float]]:
        """Return the tangents of each view: a headset's if there are two eyes."""
        if self.right_profile is None:
            usual = tangents_from_fov(VERTICAL_FOV_DEG, self.width_px, self.height_px)
            return [usual] * self.n_views
        left, right, up, down = (
            math.tan(math.radians(edge_deg)) for edge_deg in HEADSET_EDGES_DEG
        )
        return [(left, right, up, down), (-right, -left, up, down)]

    @property
    def states(self) -> list[ViewState]:
        """Return the view states, which select the eye of each view."""
        if self.right_profile is None:
            return [ViewState()] * self.n_views
        return [ViewState(eye) for eye in EYES]

    @property
    def case(self) -> str:
        """Return a description of the content."""
        views = "" if self.n_views == 1 else f"{self.n_views} x "
        eye = _name_of(self.profile)
        if self.right_profile is not None:
            eye = f"left {eye}, right {_name_of(self.right_profile)}"
        return (
            f"{views}{self.width_px}x{self.height_px} {self.output}, {eye}, "
            f"{self.pupil_diameter_mm:g} mm, {self.focus_dpt:g} dpt"
        )

    @property
    def setting(self) -> str:
        """Return a description of schedule and transport."""
        schedule = f"{self.rate_hz:g} Hz for {self.duration_s:g} s"
        how = [self.transport]
        if self.compression != "none":
            how.append(self.compression)
        if self.depth_encoding != "float32":
            how.append(f"depth {self.depth_encoding}")
        return f"{schedule}, {self.max_in_flight} in flight, {', '.join(how)}"


def _name_of(profile: Mapping[str, Any]) -> str:
    return str(profile.get("name", profile.get("kind", "profile")))


def make_frames(settings: Settings) -> list[list[RgbdView]]:
    """Return a loop of frames: a slanted checkered floor and a moving near disc."""
    width_px, height_px = settings.width_px, settings.height_px
    x, y = np.meshgrid(np.arange(width_px), np.arange(height_px))
    cell_px = max(height_px // 24, 2)
    checks = ((x // cell_px + y // cell_px) % 2).astype(np.float32)
    depth_m = (6.0 - 5.0 * y / height_px).astype(np.float32)
    frames = []
    for k in range(N_FRAMES):
        center_x = width_px * (0.2 + 0.6 * k / (N_FRAMES - 1))
        near = (x - center_x) ** 2 + (y - height_px / 2) ** 2 < (height_px / 6) ** 2
        color = np.stack([0.2 + 0.6 * checks, y / height_px, x / width_px], axis=-1)
        color[near] = (0.9, 0.7, 0.2)
        image = np.rint(255 * color).astype(np.uint8)
        depth = np.where(near, np.float32(0.5), depth_m)
        if settings.output == "linear":
            image = (color.astype(np.float32)) ** np.float32(2.2)
        frames.append([RgbdView(image, depth, edges) for edges in settings.tangents])
    return frames


def measure(client: FilterClient, settings: Settings, read_memory_mb) -> LatencyRun:
    """Prepare the eye, warm up and send the frames on schedule."""
    frames = make_frames(settings)
    look = {
        "pupil_diameter_mm": settings.pupil_diameter_mm,
        "focus_dpt": settings.focus_dpt,
        "output": settings.output,
        "depth_encoding": settings.depth_encoding,
        "states": settings.states,
    }
    _set_profiles(client, settings, frames[0])
    first_replies = [client.filter(frame, **look, timeout_s=60) for frame in frames]
    welcome = client.hello()
    run = LatencyRun(settings.case, settings.setting, welcome.server["renderer"])
    run.memory_start_mb = read_memory_mb()
    before = client.n_bytes
    loop = _Loop(client, run, [reply.colors for reply in first_replies])
    start_s = time.monotonic()
    run.n_scheduled = max(1, round(settings.rate_hz * settings.duration_s))
    for k in range(run.n_scheduled):
        loop.take_until(start_s + k / settings.rate_hz)
        frame_id = client.submit(frames[k % N_FRAMES], **look)
        loop.due[frame_id] = (start_s + k / settings.rate_hz, k % N_FRAMES)
    end_s = time.monotonic() + STRAGGLER_S
    while client.n_unanswered and time.monotonic() < end_s:
        loop.take_until(time.monotonic() + 0.01)
    loop.take_until(time.monotonic())
    run.drops["unanswered"] += client.n_unanswered
    run.drops += type(run.drops)()  # removes zero counts
    run.duration_s = time.monotonic() - start_s
    run.due_s = [due_s - start_s for due_s in run.due_s]
    run.memory_end_mb = read_memory_mb()
    sent, received = client.n_bytes
    run.n_bytes = sent - before[0], received - before[1]
    return run


def _set_profiles(
    client: FilterClient, settings: Settings, views: Sequence[RgbdView]
) -> None:
    how = settings.profile_settings
    if settings.right_profile is None:
        client.set_profile(settings.profile, settings=how, views=views)
        return
    profiles = settings.profile, settings.right_profile
    for eye, profile, view in zip(EYES, profiles, views, strict=True):
        client.set_profile(profile, eye=eye, settings=how, views=[view])


class _Loop:
    """Receives replies between due frames."""

    def __init__(self, client: FilterClient, run: LatencyRun, first_colors) -> None:
        self._client = client
        self._run = run
        self._first_colors = first_colors
        self.due: dict[int, tuple[float, int]] = {}

    def take_until(self, end_s: float) -> None:
        while True:
            remaining_s = end_s - time.monotonic()
            for event in self._client.poll(max(0.0, remaining_s)):
                self._take(event)
            if time.monotonic() >= end_s:
                return

    def _take(self, event: object) -> None:
        if isinstance(event, FilteredFrame):
            now_s = time.monotonic()
            due_s, index = self.due.pop(event.frame_id)
            age_ms = 1000 * (now_s - due_s)
            header = event.header
            stages_ms = header.stage_times_ms
            wire_ms = event.round_trip_ms - header.total_ms
            own_ms = sum(stages_ms.get(name, 0.0) for name in SERVICE_STAGES)
            times_ms = {
                "client_wait_ms": age_ms - event.round_trip_ms,
                "wire_and_queue_ms": wire_ms,
                **stages_ms,
                "added_ms": wire_ms + own_ms,
                "service_total_ms": header.total_ms,
                "round_trip_ms": event.round_trip_ms,
                "age_ms": age_ms,
            }
            self._run.add(due_s, times_ms)
            self._compare(event, index)
        elif isinstance(event, Dropped):
            self._run.drops[event.reason] += 1
        elif isinstance(event, ErrorReply):
            raise event.exception()

    def _compare(self, event: FilteredFrame, index: int) -> None:
        """Compare with the first reply to this frame, on every 16th pixel for speed."""
        for first, now in zip(self._first_colors[index], event.colors, strict=True):
            part = slice(None, None, 4)
            difference = first[part, part].astype(np.float32) - now[part, part]
            self._run.max_repeat_difference = max(
                self._run.max_repeat_difference, float(np.abs(difference).max())
            )


@contextlib.contextmanager
def connect(endpoint: str | None, settings: Settings) -> Iterator[tuple]:
    """Yield (client, reader of the service's memory); start a service if needed."""
    with contextlib.ExitStack() as stack:
        service, key_file, transport = None, None, settings.transport
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


def read_settings(arguments: argparse.Namespace) -> Settings:
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
    return Settings(
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
        with connect(parsed.endpoint, settings) as (client, memory):
            run = measure(client, settings, memory)
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
