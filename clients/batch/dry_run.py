"""`ocufilter batch --dry-run`: estimated time and cost, and what `on-axis` would lose.

Some frames are filtered on one core, each of them twice: the second time has all PSFs,
as most frames of a long batch.  What the first time takes beyond it, which is building
the eye and computing PSFs, falls from frame to frame, so it is extrapolated and not
multiplied.  Times are those of the processor, so that other programs do not count.  The
images are discarded.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.batch.manifest import LINES, Manifest
from clients.batch.run import Batch, missing_units
from clients.batch.source import SourceFrame
from clients.batch.work import FAILURES, Job, Unit, UnitRunner
from clients.frame_log import Notes, add_notes, note_line
from filter_service import BankedEye

FEWEST_FRAMES, MOST_FRAMES = 6, 24
"""Frames per profile that are measured; the more, the longer PSFs are computed."""

MEASURED_PROFILES = 8
LAST_FRAMES = 3
FEW_PSFS_RATIO = 0.1
"""Share of the time of a frame for PSFs from which no more frames are measured."""

COMPARED_PROFILES, COMPARED_FRAMES = 2, 2
STEP_DB = 20.0 * math.log10(255.0)
"""PSNR of a mean square difference of one step of 8 bits: 48.1 dB."""

SECONDS_PER_HOUR = 3600.0
MILLION = 1_000_000


@dataclass
class _Measured:
    """Times of some frames through a profile.

    Attributes
    ----------
    build_s : float
        Time until the eye was ready for its first frame.
    steady_ms : list
        Time of each frame once its PSFs are computed.
    extra_ms : list
        Time of each frame before that, beyond ``steady_ms``; the first one includes the
        build.
    """

    profile: str
    build_s: float = 0.0
    steady_ms: list[float] = field(default_factory=list)
    extra_ms: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    notes: Notes = field(default_factory=dict)

    @property
    def ms(self) -> float:
        """Return the time of a frame once its PSFs are computed, ms."""
        return float(np.median(self.steady_ms)) if self.steady_ms else math.nan

    @property
    def has_few_psfs(self) -> bool:
        """Return whether the last frames computed almost no PSFs."""
        last = self.extra_ms[-LAST_FRAMES:]
        return float(np.mean(last)) < FEW_PSFS_RATIO * self.ms

    def extra_s(self, n_frames: float) -> float:
        """Return the time for the build and for PSFs in the first frames, s.

        Beyond the measured frames, it falls inversely with the number of the frame, or
        stays as it is if it has not fallen, as with images of different sizes.
        """
        count = len(self.extra_ms)
        if n_frames <= count:
            whole = int(n_frames)
            part = (n_frames - whole) * self.extra_ms[whole] if whole < count else 0.0
            return (sum(self.extra_ms[:whole]) + part) / 1e3
        last_ms = max(float(np.mean(self.extra_ms[-LAST_FRAMES:])), 0.0)
        further = count * math.log(n_frames / count)
        if count > LAST_FRAMES and last_ms > 0.5 * float(np.mean(self.extra_ms[1:])):
            further = n_frames - count
        more_ms = 0.0 if self.has_few_psfs else last_ms * further
        return (sum(self.extra_ms) + more_ms) / 1e3

    def described(self) -> dict[str, Any]:
        """Return the measurements, for JSON."""
        return {
            "profile": self.profile,
            "measured_frames": len(self.steady_ms),
            "build_s": round(self.build_s, 2),
            "first_frames_s": _known(sum(self.extra_ms) / 1e3, 2),
            "ms_per_frame": _known(self.ms, 2),
            "bytes_per_frame": round(float(np.mean(self.sizes)))
            if self.sizes
            else None,
            "errors": self.errors,
            "notes": list(self.notes.values()),
        }


def dry_run(
    batch: Batch,
    *,
    n_workers: int,
    n_threads: int,
    price_per_core_hour: float | None,
) -> dict[str, Any]:
    """Return the report of `ocufilter batch --dry-run`."""
    missing = Counter({name: len(frames) for name, frames in batch.frames_of.items()})
    if (batch.out / LINES).is_file():
        with Manifest(batch.out, batch.described(), read_only=True) as manifest:
            units = missing_units(batch, manifest)
        missing = Counter()
        for unit in units:
            missing[unit.profile] += len(unit.frames)
    names = list(batch.frames_of)
    some = [names[k] for k in _spread(len(names), MEASURED_PROFILES)]
    started_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import clients.batch.pools"], check=False)
    with (
        tempfile.TemporaryDirectory(prefix="ocufilter-dry-run-") as folder,
        closing(UnitRunner(batch.job, Path(folder))) as runner,
    ):
        runner.open(has_own_eyes=batch.has_own_eyes)
        start_s = time.perf_counter() - started_s
        measured = [_measured(batch, name, runner) for name in some]
    known = [one for one in measured if one.steady_ms]
    mean_ms = float(np.mean([one.ms for one in known])) if known else math.nan
    sizes = [size for one in known for size in one.sizes]
    n_missing, n_cores = missing.total(), n_workers * n_threads
    core_hours = mean_ms * MILLION / 1e3 / SECONDS_PER_HOUR
    report = {
        "layout": batch.layout,
        "frames": len(batch.frames),
        "profile_count": len(batch.frames_of),
        "profiles": [one.described() for one in measured],
        "pictures": batch.count,
        "pictures_missing": n_missing,
        "cores": n_cores,
        "start_s": round(start_s, 2),
        "ms_per_picture_and_core": _known(mean_ms, 2),
        "seconds": _known(
            _seconds(batch, missing, known, start_s, n_workers, n_cores), 1
        ),
        "output_mb": _known(n_missing * float(np.mean(sizes)) / 1e6, 1)
        if sizes
        else None,
        "core_hours_per_million": _known(core_hours, 2),
        "on_axis": _compared(batch, [one.profile for one in known]),
    }
    if price_per_core_hour is not None:
        report["price_per_million"] = _known(core_hours * price_per_core_hour, 2)
    return report


def _seconds(
    batch: Batch,
    missing: Mapping[str, int],
    known: Sequence[_Measured],
    start_s: float,
    n_workers: int,
    n_cores: int,
) -> float:
    """Return the time of the missing frames, s.

    Each worker that gets frames of a profile builds its eye and computes its PSFs.
    """
    if not known:
        return math.nan
    mean_ms = float(np.mean([one.ms for one in known]))
    total_s, n_units = 0.0, 0
    for count in missing.values():
        if not count:
            continue
        units = math.ceil(count / batch.unit_frames)
        n_builders = min(n_workers, units)
        extra_s = np.mean([one.extra_s(count / n_builders) for one in known])
        total_s += n_builders * float(extra_s) + count * mean_ms / 1e3
        n_units += units
    if not n_units:
        return 0.0
    # The process that builds eyes starts with the first one.
    builds_s = [one.build_s for one in known]
    if len(builds_s) > 1:
        start_s += max(builds_s[0] - float(np.mean(builds_s[1:])), 0.0)
    return start_s + total_s / min(n_cores, n_units)


def _spread(count: int, most: int) -> list[int]:
    """Return up to ``most`` indices that are evenly spaced among ``count``."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, most))})


def _measured(batch: Batch, profile: str, runner: UnitRunner) -> _Measured:
    """Filter some frames through a profile, on one thread."""
    found, frames = _Measured(profile), batch.frames_of[profile]
    started_s = runner.build_s
    numbers = _spread(len(frames), MOST_FRAMES)
    if batch.frames[0].videos:  # which are read in order
        numbers = [*range(min(len(frames), MOST_FRAMES))]
    for number, k in enumerate(numbers):
        if number >= FEWEST_FRAMES and (not found.steady_ms or found.has_few_psfs):
            break
        segment = Path(f"{number}.mkv") if batch.job.is_video else None
        unit = Unit(number, profile, (frames[k],), segment)
        times_ms = []
        for _ in range(2):
            before_s = runner.build_s
            (record,) = runner.run(unit)
            built_s = 0.0 if batch.has_own_eyes else runner.build_s - before_s
            times_ms.append(
                record.get("cpu_ms", 0.0) + 1e3 * built_s
            )  # by another process
            if not record["ok"]:
                break
        if not record["ok"]:
            found.errors.append(record["error"])
            continue
        add_notes(found.notes, record["notes"])
        found.sizes.append(record["bytes"])
        found.steady_ms.append(times_ms[1])
        found.extra_ms.append(times_ms[0] - times_ms[1])
    found.build_s = runner.build_s - started_s
    return found


def _compared(batch: Batch, profiles: Sequence[str]) -> dict[str, Any] | None:
    """Compare some images with those of the mode on-axis, in 8 bits.

    None if that is the mode, or the eyes are those of a bank.
    """
    job, frames_of = batch.job, batch.frames_of
    if not (profiles and job.settings.follows_field):
        return None
    some = [profiles[k] for k in _spread(len(profiles), COMPARED_PROFILES)]
    chosen = [
        (name, frames_of[name][k])
        for name in some
        for k in _spread(len(frames_of[name]), COMPARED_FRAMES)
    ]
    if any(isinstance(f.eye and f.eye.profile, BankedEye) for _, f in chosen):
        return None
    started_s = time.perf_counter()
    job = replace(job, format="png")
    on_axis = replace(job, settings=job.settings.changed(mode="on-axis"))
    usual, quick = (_images(one, chosen) for one in (job, on_axis))
    numbers = sorted(usual.keys() & quick.keys())
    if not numbers:
        return None
    worst_db = min(_psnr_db(usual[k].image, quick[k].image) for k in numbers)

    def medians_ms(times_of: Callable[[_Image], float]) -> list[float]:
        return [
            round(float(np.median([times_of(found[k]) for k in numbers])), 1)
            for found in (usual, quick)
        ]

    return {
        "images": len(numbers),
        "worst_psnr_db": round(worst_db, 1),
        "is_enough": worst_db >= STEP_DB,
        "first_ms": medians_ms(lambda one: one.first_ms),
        "ms": medians_ms(lambda one: one.ms),
        "compared_s": round(time.perf_counter() - started_s, 1),
    }


@dataclass(frozen=True)
class _Image:
    """An image, and the processor times, ms, with a new eye and once it has PSFs."""

    image: NDArray[Any]
    first_ms: float
    ms: float


def _images(job: Job, chosen: Sequence[tuple[str, SourceFrame]]) -> dict[int, _Image]:
    """Return the images of frames by number."""
    found = {}
    for number, (name, frame) in enumerate(chosen):
        # A new runner builds the eye again; nothing is written.
        with closing(UnitRunner(job, Path())) as runner, suppress(*FAILURES):
            has_own_eye = frame.eye is not None
            runner.open(has_own_eyes=has_own_eye)
            times_ms = []
            for _ in range(2):
                started_s = time.process_time()
                image, _, _ = runner.filtered(name, frame)
                times_ms.append(1e3 * (time.process_time() - started_s))
            if not has_own_eye:  # built by another process
                times_ms[0] += 1e3 * runner.build_s
            found[number] = _Image(image, *times_ms)
    return found


def _psnr_db(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the PSNR of 8-bit images, dB; at most 99, for equal images."""
    error = float(np.square(first.astype(float) - second).mean())
    return min(STEP_DB - 10.0 * math.log10(max(error, 1e-12)), 99.0)


def _known(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def lines_of(report: dict[str, Any], price_per_core_hour: float | None) -> list[str]:
    """Format the report as lines of text."""
    n_profiles, some = report["profile_count"], report["profiles"]
    few = "" if len(some) == n_profiles else f" ({len(some)} measured)"
    lines = [
        f"{report['frames']} frames of the layout {report['layout']}, "
        f"{n_profiles} profiles{few}: {report['pictures']} images, "
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
        lines.append(
            f"  {one['profile']}: {measured}; eye and PSFs "
            f"{one['first_frames_s'] or 0.0:.1f} s"
        )
        for text, count in Counter(one["errors"]).items():
            times = f" ({count} frames)" if count > 1 else ""
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
    if (compared := report["on_axis"]) is not None:
        lines.append(_on_axis_line(compared))
    return lines


def _on_axis_line(compared: Mapping[str, Any]) -> str:
    """Return a line about the mode on-axis."""
    (first_ms, quick_first_ms), (ms, quick_ms) = compared["first_ms"], compared["ms"]
    found = (
        f"{compared['worst_psnr_db']:g} dB against this mode in the worst of "
        f"{compared['images']} images; {quick_first_ms:g} instead of {first_ms:g} ms "
        f"for an image with a new eye, {quick_ms:g} instead of {ms:g} for others"
    )
    if compared["is_enough"]:
        return f"the mode on-axis is enough (less than a step of 8 bits): {found}"
    return f"the mode on-axis would lose detail: {found}"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 120.0 else f"{minutes / 60.0:.1f} h"
