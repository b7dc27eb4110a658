"""The batch that a command line describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clients.batch.eye_options import (
    check_own_eyes,
    rows_of,
    way_of_eyes,
    with_own_eyes,
)
from clients.batch.eyes import MAX_DRAWN
from clients.batch.layouts import list_frames, optics_of
from clients.batch.options import (
    FPS_LIMITS_HZ,
    BatchOptions,
    check_options,
    profiles_of,
)
from clients.batch.run import Batch
from clients.batch.source import Constant, SourceFrame, States, read_states
from clients.batch.views import Views
from clients.batch.work import (
    FORMATS,
    LINEAR_FORMATS,
    VIDEO_FORMATS,
    Job,
    batch_settings,
)
from clients.commands.options import read_object
from estimator import InvalidFile


def batch_of(options: BatchOptions) -> Batch:
    """Return the batch that the command line describes.

    Raises
    ------
    ValueError
        If an option is invalid.  The message names the option, the value and the range.
    """
    check_options(
        options,
        limit=(1, float("inf")),
        fps=FPS_LIMITS_HZ,
        price_per_core_hour=(0.0, float("inf")),
        depth_scale=(1e-9, 1e9),
        sample_eyes=(1, MAX_DRAWN),
    )
    _check_format(options)
    way = way_of_eyes(options)
    views = Views.of(options.distance_m, options.pupil_mm, options.focus_dpt)
    rows = rows_of(options)
    constant = Constant(views.distances_dpt[0]) if views.distances_dpt else None
    if constant is None and rows and all("distance_m" in row.values for row in rows):
        constant = Constant(0.0)  # which each row replaces
    layout, frames = list_frames(
        options.source,
        options.layout,
        options.depth,
        optics_of(options.fov_deg, options.intrinsics),
        options.depth_scale,
        constant,
    )
    if views.count > 1:
        _check_several(options, way)
    common: dict[str, Any] = {
        "format": options.format,
        "half": options.half,
        "engine": options.engine,
        "render_tolerance": options.render_tolerance,
    }
    if way is not None:
        check_own_eyes(options, way)
        frames, settings, details = with_own_eyes(options, views, rows, frames)
        states = States(views.pupils_mm[0], views.foci_dpt[0])
        job = Job(profiles={}, settings=settings, states=states, **common)
        frames = frames[: options.limit]
        return Batch(job, layout, options.source, frames, options.out, details)
    frames = frames[: options.limit]
    if options.fps is not None:
        frames = [replace(frame, time_s=None) for frame in frames]
    frames, states = views.of_frames(frames)
    if options.states is not None:
        states = _listed(options.states, states, [frame.name for frame in frames])
    profiles = profiles_of(options, options.profile or ())
    given = read_object("--settings", options.settings)
    job = Job(
        profiles=profiles,
        settings=batch_settings(given, states, views.distances_dpt),
        states=states,
        rate_hz=_rate_hz(options, frames),
        **common,
    )
    return Batch(job, layout, options.source, frames, options.out)


def _check_format(options: BatchOptions) -> None:
    if options.format in VIDEO_FORMATS:
        import clients.batch.video_writing  # noqa: F401  (raises if it is not installed)
    if options.half and options.format not in LINEAR_FORMATS:
        raise ValueError("--half: allowed with --format npy or exr")


def _check_several(options: BatchOptions, way: str | None) -> None:
    """Check that frames may be filtered in several states."""
    several = "several distances, pupils or foci"
    if way not in (None, "--states"):
        raise ValueError(f"{way} and {several} are given; allowed: one of them")
    if options.states is not None:
        raise ValueError(f"--states and {several} are given; allowed: one of them")
    if options.format in VIDEO_FORMATS:
        allowed = ", ".join(name for name in FORMATS if name not in VIDEO_FORMATS)
        raise ValueError(
            f"--format is {options.format}, with {several}; allowed: {allowed}"
        )


def _listed(path: Path, states: States, names: Sequence[str]) -> States:
    """Return states with the values of a table."""
    states = replace(states, listed=read_states(path, names))
    states.check(names)
    return states


def _rate_hz(options: BatchOptions, frames: Sequence[SourceFrame]) -> float:
    if options.fps is not None:
        return float(options.fps)
    if frames[0].color_index is None:
        return 30.0
    from clients.batch.video_reading import frames_per_second

    rate_hz = frames_per_second(frames[0].color)
    low_hz, high_hz = FPS_LIMITS_HZ
    if not low_hz <= rate_hz <= high_hz:
        allowed = f"{low_hz:g} to {high_hz:g}, or --fps"
        raise InvalidFile(frames[0].color, f"{rate_hz:g} frames per second", allowed)
    return rate_hz
