"""Estimate of a batch's time, and of the cost of a million images.

The estimate filters the first frames on one core and discards the images.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from clients.batch.manifest import LINES, Manifest, note_line
from clients.batch.run import Batch, missing_units
from clients.batch.work import Unit, UnitRunner
from clients.frame_log import Notes, add_notes

MEASURED_FRAMES = 6
"""Frames per profile, of which the first one is a warm-up."""

SECONDS_PER_HOUR = 3600.0
MILLION = 1_000_000


def dry_run(
    batch: Batch, *, n_cores: int, price_per_core_hour: float | None
) -> dict[str, Any]:
    """Return the report of `ocufilter batch --dry-run`."""
    n_all = len(batch.frames) * len(batch.job.profiles)
    n_missing = n_all
    if (batch.out / LINES).is_file():
        job = batch.described()
        with Manifest(batch.out, job, read_only=True) as manifest:
            units = missing_units(batch, manifest)
        n_missing = sum(len(unit.frames) for unit in units)
    measured = [_measured(batch, profile) for profile in batch.job.profiles]
    ms = [one["ms_per_frame"] for one in measured if one["ms_per_frame"] is not None]
    mean_ms = float(np.mean(ms)) if ms else math.nan
    sizes = [one["bytes_per_frame"] for one in measured if one["bytes_per_frame"]]
    # A helper process of each worker computes the PSFs, once per profile.
    builds_s = sum(one["build_s"] for one in measured) if n_missing else 0.0
    core_hours = mean_ms * MILLION / 1e3 / SECONDS_PER_HOUR
    report = {
        "layout": batch.layout,
        "frames": len(batch.frames),
        "profiles": measured,
        "pictures": n_all,
        "pictures_missing": n_missing,
        "cores": n_cores,
        "ms_per_picture_and_core": _known(mean_ms, 2),
        "seconds": _known(n_missing * mean_ms / 1e3 / n_cores + builds_s, 1),
        "output_mb": _known(n_missing * float(np.mean(sizes)) / 1e6, 1)
        if sizes
        else None,
        "core_hours_per_million": _known(core_hours, 2),
    }
    if price_per_core_hour is not None:
        report["price_per_million"] = _known(core_hours * price_per_core_hour, 2)
    return report


def _known(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _measured(batch: Batch, profile: str) -> dict[str, Any]:
    """Filter the first frames through a profile, on one thread."""
    frames = batch.frames[:MEASURED_FRAMES]
    times_ms, sizes, errors = [], [], []
    notes: Notes = {}
    build_s = 0.0
    with tempfile.TemporaryDirectory(prefix="ocufilter-dry-run-") as folder:
        runner = UnitRunner(batch.job, Path(folder))
        try:
            for number, frame in enumerate(frames):
                segment = Path(f"{number}.mkv") if batch.job.is_video else None
                unit = Unit(number, profile, (frame,), segment)
                started_s = time.perf_counter()
                (record,) = runner.run(unit)
                took_ms = 1e3 * (time.perf_counter() - started_s)
                if not record["ok"]:
                    errors.append(record["error"])
                    continue
                add_notes(notes, record["notes"])
                sizes.append(record["bytes"])
                if "build" not in record["ms"]:
                    times_ms.append(took_ms)
            build_s = runner.build_s
        finally:
            runner.close()
    return {
        "profile": profile,
        "measured_frames": len(times_ms),
        "build_s": round(build_s, 2),
        "ms_per_frame": round(float(np.median(times_ms)), 2) if times_ms else None,
        "bytes_per_frame": round(float(np.mean(sizes))) if sizes else None,
        "errors": errors,
        "notes": list(notes.values()),
    }


def lines_of(report: dict[str, Any], price_per_core_hour: float | None) -> list[str]:
    """Format the report as lines of text."""
    lines = [
        f"{report['frames']} frames of the layout {report['layout']}, "
        f"{len(report['profiles'])} profiles: {report['pictures']} images, "
        f"{report['pictures_missing']} of them missing"
    ]
    for one in report["profiles"]:
        took = one["ms_per_frame"]
        measured = (
            "no frame was measured"
            if took is None
            else f"{took:.1f} ms per frame on one core ({one['measured_frames']} "
            f"measured), {one['bytes_per_frame'] / 1e6:.2f} MB"
        )
        lines.append(f"  {one['profile']}: {measured}; PSFs {one['build_s']:.1f} s")
        for text, count in Counter(one["errors"]).items():
            times = f" ({count} of {MEASURED_FRAMES} frames)" if count > 1 else ""
            lines.append(f"    error: {text}{times}")
        lines += [f"    note: {note_line(note)}" for note in one["notes"]]
    if report["seconds"] is not None:
        lines.append(
            f"about {_duration(report['seconds'])} on {report['cores']} cores, "
            f"{report['output_mb']:g} MB"
        )
        cost = f"a million images: {report['core_hours_per_million']:g} core-hours"
        if price_per_core_hour is not None:
            cost += f", {report['price_per_million']:g} at {price_per_core_hour:g} each"
        lines.append(cost)
    return lines


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 120.0 else f"{minutes / 60.0:.1f} h"
