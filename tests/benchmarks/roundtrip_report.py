"""Results of a latency run, as numbers, table, JSON and plot."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from clients.latency.stream import SUMS, LatencyRun

PERCENTILES = (50, 95, 99, 99.9)


def case_of(run: LatencyRun) -> str:
    """Return a description of the content."""
    settings = run.settings
    views = "" if settings.n_views == 1 else f"{settings.n_views} x "
    eye = _name_of(settings.profile)
    if settings.right_profile is not None:
        eye = f"left {eye}, right {_name_of(settings.right_profile)}"
    state = f"{settings.pupil_diameter_mm:g} mm, {settings.focus_dpt:g} dpt"
    if settings.is_moving:
        state = "moving pupil and focus"
    size = f"{settings.width_px}x{settings.height_px}"
    return f"{views}{size} {settings.output}, {eye}, {state}"


def setting_of(run: LatencyRun) -> str:
    """Return a description of schedule and transport."""
    settings = run.settings
    schedule = f"{settings.rate_hz:g} Hz for {settings.duration_s:g} s"
    how = [settings.transport]
    if settings.compression != "none":
        how.append(settings.compression)
    if settings.depth_encoding != "float32":
        how.append(f"depth {settings.depth_encoding}")
    return f"{schedule}, {settings.max_in_flight} in flight, {', '.join(how)}"


def _name_of(profile: Mapping[str, Any]) -> str:
    return str(profile.get("name", profile.get("kind", "profile")))


def percentiles_ms(run: LatencyRun, stage: str) -> dict[float, float]:
    """Return `PERCENTILES` of one stage."""
    values = np.percentile(run.stages_ms[stage], PERCENTILES)
    return dict(zip(PERCENTILES, values.tolist(), strict=True))


def as_json(run: LatencyRun) -> dict[str, Any]:
    """Return the run in the format of `ocufilter bench`: each time with an error."""
    rows = []
    for name in run.stage_names():
        p = percentiles_ms(run, name)
        rows.append(
            {
                "bench": "roundtrip",
                "method": name,
                "case": case_of(run),
                "setting": setting_of(run),
                "n": run.n_filtered,
                "median_ms": p[50],
                "p95_ms": p[95],
                "p99_ms": p[99],
                "p99_9_ms": p[99.9],
                "memory_mb": run.memory_end_mb,
                "error_name": "max_abs_repeat_difference",
                "error": run.max_repeat_difference,
                "reference": "first reply to the same frame",
            }
        )
    return {
        "machine": machine() | {"renderer": run.renderer},
        "commit": commit(),
        "rows": rows,
        "frames": {
            "scheduled": run.settings.n_scheduled,
            "filtered": run.n_filtered,
            "dropped": dict(run.drops),
            "filtered_hz": run.n_filtered / run.duration_s,
            "bytes_sent_per_frame": run.n_bytes_per_frame[0],
            "bytes_received_per_frame": run.n_bytes_per_frame[1],
            "bare_socket_ms": run.floor_ms,
        },
        "service_memory_mb": {"start": run.memory_start_mb, "end": run.memory_end_mb},
    }


def as_table(run: LatencyRun) -> Table:
    """Return the run as a terminal table."""
    table = Table(title=f"{case_of(run)}, {setting_of(run)}", title_justify="left")
    table.add_column("stage")
    for percentile in PERCENTILES:
        table.add_column(f"p{percentile:g} [ms]", justify="right")
    for name in run.stage_names():
        if name == SUMS[0]:
            table.add_section()
        values = percentiles_ms(run, name).values()
        table.add_row(name.removesuffix("_ms"), *(f"{value:.2f}" for value in values))
    return table


def summary(run: LatencyRun) -> str:
    """Return the run in one line."""
    dropped = ", ".join(f"{n} {reason}" for reason, n in run.drops.items()) or "none"
    up_mb, down_mb = (n_bytes / 1e6 for n_bytes in run.n_bytes_per_frame)
    return (
        f"{up_mb:.2f} MB up and {down_mb:.2f} MB down a frame, "
        f"{run.floor_ms:.2f} ms over a bare socket; "
        f"{run.n_filtered} of {run.settings.n_scheduled} frames filtered "
        f"({run.n_filtered / run.duration_s:.1f} Hz), dropped: {dropped}; service "
        f"memory {run.memory_start_mb:.0f} to {run.memory_end_mb:.0f} MB; largest "
        f"difference between replies to one frame {run.max_repeat_difference:g}"
    )


def save_plot(run: LatencyRun, path: Path) -> None:
    """Plot the age over the run and the stages to a file."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (over_time, by_stage) = pyplot.subplots(1, 2, figsize=(12, 4.5))
    over_time.plot(run.due_s, run.stages_ms["age_ms"], ".", label="age of the reply")
    over_time.plot(
        run.due_s, run.stages_ms["service_total_ms"], ".", label="time in the service"
    )
    over_time.set(xlabel="scheduled at [s]", ylabel="[ms]", title=case_of(run))
    over_time.set_ylim(bottom=0)
    over_time.legend()
    names = [name for name in run.stage_names() if name not in SUMS][::-1]
    places = np.arange(len(names))
    for offset, percentile in zip((0.3, 0.1, -0.1, -0.3), PERCENTILES, strict=True):
        values = [percentiles_ms(run, name)[percentile] for name in names]
        by_stage.barh(places + offset, values, height=0.2, label=f"p{percentile:g}")
    by_stage.set_yticks(places, [name.removesuffix("_ms") for name in names])
    by_stage.set(xlabel="[ms]", title=setting_of(run))
    by_stage.legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def machine() -> dict[str, Any]:
    """Return the machine properties that the times depend on."""
    import os

    return {
        "system": platform.platform(),
        "python": platform.python_version(),
        "cpu_count": os.cpu_count(),
    }


def commit() -> str:
    """Return the commit of this checkout, or ``unknown``."""
    try:
        finished = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return finished.stdout.strip()
