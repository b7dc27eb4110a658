"""One stream for each case, the error of the results, and text, JSON and plot."""

from __future__ import annotations

import math
import os
import platform
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from clients.filter_client import FilterClient
from clients.frame_log import percentiles
from clients.latency.stream import (
    FOCUS_RANGE_DPT,
    N_FRAMES,
    PUPIL_RANGE_MM,
    SUMS,
    WARM_UP,
    LatencyRun,
    StreamSettings,
    make_frames,
    measure_stream,
    profile_change_ms,
)

PUPIL_MM, FOCUS_DPT = 4.0, 0.0
"""State of a stream that does not move."""

N_CHANGES = 3
N_COMPARED = 3
"""Number of profile changes, and of frames whose error is computed, of each case."""

REFERENCE = (
    "the same frames in this process: render_tolerance 0, no merging, tolerance fine"
)
EQUAL_PSNR_DB = 300.0
"""Value for equal images, since JSON has no infinity."""

PERCENTILES = {"p50": 50, "p90": 90, "p99": 99, "max": 100}
NAME_COLUMN = 44  # at least
_percentiles = partial(percentiles, percents=PERCENTILES)


@dataclass(frozen=True)
class Case:
    """A stream: transport, size of a view in px, number of views and frame rate."""

    transport: str  # "auto", "tcp" or "shared-memory"
    size_px: tuple[int, int]
    n_views: int
    rate_hz: float


@dataclass(frozen=True)
class Target:
    """The service, and the parameters that all cases share.

    Attributes
    ----------
    endpoint : str
    key_file : Path or None
    timeout_s : float
        Timeout of the connection.
    profile : dict
        Profile of the eye; of both eyes of a stereo frame.
    profile_settings : dict
    n_frames : int
        Number of frames that are measured.
    is_moving : bool
        Whether pupil and focus change in every frame.
    """

    endpoint: str
    key_file: Path | None
    timeout_s: float
    profile: dict[str, Any]
    profile_settings: dict[str, Any]
    n_frames: int
    is_moving: bool


@dataclass
class Measured:
    """Results of a case.

    Attributes
    ----------
    case : Case
    run : LatencyRun
    carrier : str
        What carried the images: "shared memory", or the endpoint's scheme, with
        "CURVE" if it was encrypted.
    change_ms : list of float
        Times from a request for another eye to its first frame.
    n_other_sessions : int
        Sessions of other clients at the start.
    server : mapping
        Description of the service.
    error : dict or None
        Of 8-bit images: PSNR (peak 255), largest difference in levels, and the frames.
        None before `compare`, or if it failed or no frame was filtered.
    """

    case: Case
    run: LatencyRun
    carrier: str
    change_ms: list[float]
    n_other_sessions: int
    server: Mapping[str, str]
    error: dict[str, Any] | None = None

    @property
    def label(self) -> str:
        """Return transport, size and rate in a few words."""
        width_px, height_px = self.case.size_px
        stereo = "2 x " * (self.case.n_views == 2)
        size = f"{stereo}{width_px}x{height_px}"
        return f"{self.carrier}, {size}, {self.case.rate_hz:g} Hz"


def measure(target: Target, case: Case) -> Measured:
    """Measure one case in a separate session.

    Raises
    ------
    FilterError
        If the service does not answer, rejects the client, or cannot filter.
    ValueError
        If shared memory is required and not offered, or a frame is too large.
    """
    width_px, height_px = case.size_px
    settings = StreamSettings(
        width_px=width_px,
        height_px=height_px,
        n_views=case.n_views,
        rate_hz=case.rate_hz,
        duration_s=target.n_frames / case.rate_hz,
        profile=target.profile,
        right_profile=target.profile if case.n_views == 2 else None,
        profile_settings=target.profile_settings,
        pupil_diameter_mm=PUPIL_MM,
        focus_dpt=FOCUS_DPT,
        output="srgb8",
        max_in_flight=1,
        is_moving=target.is_moving,
    )
    with FilterClient(
        target.endpoint,
        timeout_s=target.timeout_s,
        client_name="ocufilter latency",
        shared_memory=case.transport != "tcp",
        key_file=target.key_file,
    ) as client:
        welcome = client.hello()
        if case.transport == "shared-memory" and "shm" not in welcome.transports:
            raise ValueError(
                f"--transport is shared-memory, which {target.endpoint} does not offer "
                "to this client; allowed: tcp, auto"
            )
        limits = welcome.limits
        if width_px > limits.max_width_px or height_px > limits.max_height_px:
            raise ValueError(
                f"--size is {width_px}x{height_px}; allowed by {target.endpoint}: up "
                f"to {limits.max_width_px}x{limits.max_height_px}"
            )
        if case.n_views > limits.max_views:
            raise ValueError(
                f"--stereo: {target.endpoint} allows {limits.max_views} view per frame"
            )
        _, pong = client.ping()
        run = measure_stream(
            client,
            settings,
            lambda: client.ping(timeout_s=30.0)[1].memory_mb,
            n_kept=N_COMPARED,
        )
        change_ms = [
            profile_change_ms(client, settings, _new_profile())
            for _ in range(N_CHANGES)
        ]
    return Measured(
        case,
        run,
        _carrier(target, run),
        change_ms,
        max(0, pong.n_sessions - 1),
        welcome.server,
    )


def _new_profile() -> dict[str, Any]:
    """Return a prescription that no cache of the service contains."""
    sphere_dpt = -(1000 + secrets.randbelow(2000)) / 1000
    return {
        "kind": "prescription",
        "eye_side": "OD",
        "sphere_dpt": sphere_dpt,
        "cylinder_dpt": -0.5,
        "axis_deg": 20,
    }


def _carrier(target: Target, run: LatencyRun) -> str:
    scheme = urlsplit(target.endpoint).scheme
    by_message = scheme if target.key_file is None else f"{scheme} with CURVE"
    if run.n_in_memory == 0:
        return by_message
    if run.n_in_memory == run.n_filtered:
        return "shared memory"
    return f"shared memory ({run.n_in_memory} of {run.n_filtered}) and {by_message}"


def compare(target: Target, results: Sequence[Measured]) -> None:
    """Compute the error of the kept frames against exact frames of this process.

    This takes all cores, so call it after all cases are measured.

    Raises
    ------
    FilterError
        If this machine cannot filter.
    """
    from filter_service import EyeFilter

    settings = target.profile_settings | {"tolerance": "fine"}
    # Cases of other transports have the same frames: an exact one of a headset's size
    # takes a minute on two cores.
    references: dict[tuple[object, ...], list[NDArray[np.int16]]] = {}
    with EyeFilter(target.profile, settings=settings) as exact:
        for found in results:
            run = found.run.settings
            frames = make_frames(run)
            squares, n_values, worst = 0.0, 0, 0
            for kept in found.run.kept:
                k_frame = kept.index % N_FRAMES
                state = {
                    name: kept.values[name]
                    for name in ("pupil_diameter_mm", "focus_dpt", "output")
                }
                shape = run.width_px, run.height_px, repr(run.tangents), run.output
                key = (*shape, k_frame, *state.values())
                if key not in references:
                    reference = exact.filter(
                        frames[k_frame], **state, render_tolerance=0.0, merge=False
                    )
                    references[key] = [
                        view.color.astype(np.int16) for view in reference.views
                    ]
                for view, color in zip(references[key], kept.colors, strict=True):
                    difference = np.abs(view - color)
                    squares += float(np.square(difference, dtype=np.float64).sum())
                    n_values += difference.size
                    worst = max(worst, int(difference.max()))
            if n_values:
                psnr_db = EQUAL_PSNR_DB
                if squares > 0.0:
                    psnr_db = 10.0 * math.log10(255.0**2 * n_values / squares)
                found.error = {
                    "psnr_db": round(psnr_db, 3),
                    "worst_difference": worst,
                    "frames": [kept.index for kept in found.run.kept],
                }


def as_json(target: Target, results: Sequence[Measured]) -> dict[str, Any]:
    """Return everything that was measured; times in ms."""
    return {
        "endpoint": target.endpoint,
        "service": dict(results[0].server),
        "machine": {
            "system": platform.platform(),
            "python": platform.python_version(),
            "cpu_count": os.cpu_count(),
        },
        "warm_up": WARM_UP,
        "state": _state(target),
        "reference": REFERENCE,
        "rows": [_row(found) for found in results],
    }


def _row(found: Measured) -> dict[str, Any]:
    run, (width_px, height_px) = found.run, found.case.size_px
    sent, received = run.n_bytes_per_frame
    return {
        "transport": found.carrier,
        "width_px": width_px,
        "height_px": height_px,
        "views": found.case.n_views,
        "rate_hz": found.case.rate_hz,
        "frames": {
            "scheduled": run.settings.n_scheduled,
            "filtered": run.n_filtered,
            "dropped": dict(run.drops),
            "filtered_hz": round(run.n_filtered / run.duration_s, 3),
            "bytes_sent": sent,
            "bytes_received": received,
        },
        "round_trip_ms": _percentiles(run.stages_ms.get("round_trip_ms", ())),
        "age_ms": _percentiles(run.stages_ms.get("age_ms", ())),
        "shown_age_ms": _percentiles(run.shown_age_ms),
        "stages_ms": {
            name.removesuffix("_ms"): _percentiles(run.stages_ms[name])
            for name in (*_stages(run), *SUMS[:2])
            if name in run.stages_ms
        },
        "profile_change_ms": _percentiles(found.change_ms)
        | {"n": len(found.change_ms)},
        "error": found.error,
        "other_sessions": found.n_other_sessions,
        "service_memory_mb": round(run.memory_end_mb, 1),
    }


def as_text(target: Target, results: Sequence[Measured]) -> list[str]:
    """Return lines: the rules, a table for each case, and one of all cases."""
    server = results[0].server
    lines = [
        f"{target.endpoint}: ocufilter {server.get('version', 'of unknown version')}, "
        f"{server.get('renderer', 'unknown renderer')}",
        f"warm-up: {WARM_UP}",
        f"state: {_state(target)}",
        f"error: against {REFERENCE}",
    ]
    for found in results:
        lines += ["", *_table(found)]
    if len(results) > 1:
        lines += ["", *_overview(results)]
    return lines


def _state(target: Target) -> str:
    if not target.is_moving:
        return "the same pupil and focus in every frame"
    (low_mm, high_mm), (far_dpt, near_dpt) = PUPIL_RANGE_MM, FOCUS_RANGE_DPT
    return (
        f"pupil ({low_mm:g} to {high_mm:g} mm) and focus ({far_dpt:g} to "
        f"{near_dpt:g} dpt) change in every frame"
    )


def _table(found: Measured) -> list[str]:
    row = _row(found)
    frames, error = row["frames"], row["error"]
    lines = [found.label, _line("  [ms]", list(PERCENTILES))]
    timed = {
        "round trip": row["round_trip_ms"],
        "age of a frame when it arrives": row["age_ms"],
        "age of the shown picture": row["shown_age_ms"],
        **{
            f"  {name.replace('_', ' ')}": times
            for name, times in row["stages_ms"].items()
        },
        f"profile change to first frame ({N_CHANGES} times)": row["profile_change_ms"],
    }
    for name, times in timed.items():
        values = [times[percentile] for percentile in PERCENTILES]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        lines.append(_line(f"  {name}", shown))
    dropped = ", ".join(f"{n} {why}" for why, n in frames["dropped"].items()) or "none"
    lines.append(
        f"  {frames['filtered']} of {frames['scheduled']} frames filtered "
        f"({frames['filtered_hz']:.1f} Hz), dropped: {dropped}; "
        f"{frames['bytes_sent'] / 1e6:.2f} MB sent and "
        f"{frames['bytes_received'] / 1e6:.2f} MB received for each"
    )
    if error is not None:
        lines.append(
            f"  error of {len(error['frames'])} frames: {error['psnr_db']:.1f} dB "
            f"PSNR, worst pixel {error['worst_difference']} of 255"
        )
    if row["other_sessions"]:
        lines.append(
            f"  other sessions of the service: {row['other_sessions']}; their work is "
            "part of these times"
        )
    return lines


def _line(name: str, values: Sequence[str], width: int = NAME_COLUMN) -> str:
    return f"{name:<{width}}" + "".join(f"{value:>10}" for value in values)


def _overview(results: Sequence[Measured]) -> list[str]:
    names = ["trip p50", "trip p99", "age p50", "dropped", "PSNR dB"]
    width = max(NAME_COLUMN, *(len(found.label) + 2 for found in results))
    lines = [_line("all cases [ms]", names, width)]
    for found in results:
        row = _row(found)
        times = (
            row["round_trip_ms"]["p50"],
            row["round_trip_ms"]["p99"],
            row["age_ms"]["p50"],
        )
        shown = ["-" if value is None else f"{value:.2f}" for value in times]
        error = row["error"]
        psnr = "-" if error is None else f"{error['psnr_db']:.1f}"
        n_dropped = sum(row["frames"]["dropped"].values())
        lines.append(_line(f"  {found.label}", [*shown, str(n_dropped), psnr], width))
    return lines


def save_plot(results: Sequence[Measured], path: Path) -> None:
    """Plot the distribution of the times, and the median stages, to a PNG file."""
    from matplotlib.figure import Figure  # loads slowly

    height_in = 4.5 + 0.7 * len(results)
    figure = Figure(figsize=(13, height_in), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False)[0]
    ways, stages = left.subplots(), right.subplots()
    for number, found in enumerate(results):
        color = f"C{number % 10}"
        for name, style in (("round_trip_ms", "-"), ("age_ms", "--")):
            times_ms = np.sort(found.run.stages_ms.get(name, []))
            share = 100 * np.arange(1, len(times_ms) + 1) / max(1, len(times_ms))
            label = found.label if style == "-" else None
            ways.step(times_ms, share, style, color=color, where="post", label=label)
    ways.set(xlabel="[ms]", ylabel="frames [%]", ylim=(0, 100))
    ways.set_title("round trip (solid), age on arrival (dashed)")
    ways.set_xlim(left=0)
    left.legend(loc="outside lower center", fontsize="small")
    names = dict.fromkeys(name for found in results for name in _stages(found.run))
    start_ms = np.zeros(len(results))
    for number, name in enumerate(names):
        median_ms = np.array(
            [np.median(found.run.stages_ms.get(name, [0.0])) for found in results]
        )
        stages.barh(
            range(len(results)),
            median_ms,
            left=start_ms,
            label=name.removesuffix("_ms").replace("_", " "),
            color=f"C{number % 10}",
            hatch="/" * (number // 10),
        )
        start_ms += median_ms
    stages.set_yticks(range(len(results)), [_plot_label(found) for found in results])
    stages.tick_params(axis="y", labelsize="small")
    stages.invert_yaxis()
    stages.set(xlabel="[ms]", title="median of each stage")
    right.legend(loc="outside lower center", fontsize="small", ncols=4)
    figure.savefig(path, dpi=110, format="png")


def _plot_label(found: Measured) -> str:
    label = found.label.replace(", ", "\n")
    error = found.error
    return label if error is None else f"{label}\n{error['psnr_db']:.1f} dB PSNR"


def _stages(run: LatencyRun) -> list[str]:
    return [name for name in run.stage_names() if name not in SUMS]
