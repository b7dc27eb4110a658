"""Text, JSON and plot of the results of `ocufilter latency`."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clients.latency.measure import N_CHANGES, REFERENCE, Measured, Target
from clients.latency.stream import (
    FOCUS_RANGE_DPT,
    PUPIL_RANGE_MM,
    SUMS,
    WARM_UP,
    LatencyRun,
)

PERCENTILES = {"p50": 50, "p90": 90, "p99": 99, "max": 100}
NAME_COLUMN = 44  # at least


def percentiles(values_ms: Sequence[float]) -> dict[str, float | None]:
    """Return p50, p90, p99 and the maximum, rounded to microseconds."""
    if not values_ms:
        return dict.fromkeys(PERCENTILES)
    found = np.percentile(values_ms, list(PERCENTILES.values()))
    return {
        name: round(float(value), 3)
        for name, value in zip(PERCENTILES, found, strict=True)
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
            "scheduled": run.n_scheduled,
            "filtered": run.n_filtered,
            "dropped": dict(run.drops),
            "filtered_hz": round(run.n_filtered / run.duration_s, 3),
            "bytes_sent": sent,
            "bytes_received": received,
        },
        "round_trip_ms": percentiles(run.stages_ms.get("round_trip_ms", ())),
        "age_ms": percentiles(run.stages_ms.get("age_ms", ())),
        "shown_age_ms": percentiles(run.shown_age_ms),
        "stages_ms": {
            name.removesuffix("_ms"): percentiles(run.stages_ms[name])
            for name in (*_stages(run), *SUMS[:2])
            if name in run.stages_ms
        },
        "profile_change_ms": percentiles(found.change_ms) | {"n": len(found.change_ms)},
        "error": None
        if found.error is None
        else {
            "psnr_db": round(found.error.psnr_db, 3),
            "worst_difference": found.error.worst_difference,
            "frames": [kept.index for kept in run.kept],
        },
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
    if found.error is None:
        return label
    return f"{label}\n{found.error.psnr_db:.1f} dB PSNR"


def _stages(run: LatencyRun) -> list[str]:
    return [name for name in run.stage_names() if name not in SUMS]
