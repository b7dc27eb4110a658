"""One stream for each case, and the error of what came back."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from clients.filter_client import FilterClient
from clients.latency.stream import (
    N_FRAMES,
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


@dataclass(frozen=True)
class Case:
    """A stream: transport, size of a view in px, number of views and frame rate."""

    transport: str  # "auto", "tcp" or "shared-memory"
    size_px: tuple[int, int]
    n_views: int
    rate_hz: float


@dataclass(frozen=True)
class Target:
    """The service, and what is the same in all cases.

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


@dataclass(frozen=True)
class PictureError:
    """Error of 8-bit images: PSNR (peak 255), and the largest difference in levels."""

    psnr_db: float
    worst_difference: int


@dataclass
class Measured:
    """Results of a case.

    Attributes
    ----------
    case : Case
    settings : StreamSettings
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
    error : PictureError or None
        None before `compare`, or if it failed or no frame was filtered.
    """

    case: Case
    settings: StreamSettings
    run: LatencyRun
    carrier: str
    change_ms: list[float]
    n_other_sessions: int
    server: Mapping[str, str]
    error: PictureError | None = None

    @property
    def label(self) -> str:
        """Return transport, size and rate in a few words."""
        width_px, height_px = self.case.size_px
        stereo = "2 x " * (self.case.n_views == 2)
        size = f"{stereo}{width_px}x{height_px}"
        return f"{self.carrier}, {size}, {self.case.rate_hz:g} Hz"


def measure(target: Target, case: Case) -> Measured:
    """Measure one case in a session of its own.

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
        settings,
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
    with EyeFilter(target.profile, settings=settings) as exact:
        for found in results:
            frames = make_frames(found.settings)
            squares, n_values, worst = 0.0, 0, 0
            for kept in found.run.kept:
                values = kept.values
                reference = exact.filter(
                    frames[kept.index % N_FRAMES],
                    pupil_diameter_mm=values["pupil_diameter_mm"],
                    focus_dpt=values["focus_dpt"],
                    output=values["output"],
                    render_tolerance=0.0,
                    merge=False,
                )
                for view, color in zip(reference.views, kept.colors, strict=True):
                    difference = np.abs(view.color.astype(np.int16) - color)
                    squares += float(np.square(difference, dtype=np.float64).sum())
                    n_values += difference.size
                    worst = max(worst, int(difference.max()))
            if n_values:
                found.error = PictureError(_psnr_db(squares / n_values), worst)


def _psnr_db(mean_square: float) -> float:
    if mean_square == 0.0:
        return EQUAL_PSNR_DB
    return float(10.0 * np.log10(255.0**2 / mean_square))
