"""From a profile's body to its PSF store: the work that the worker process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from estimator.profiles import EyeProfile, parse_profile
from estimator.psf import PsfTooLarge
from filter_service.build_job import BuildJob, BuiltStore
from filter_service.errors import BuildFailed, GridTooLarge, UnknownProfile
from filter_service.eye_model import ABERRATION_SHARE, prepare_eye
from filter_service.messages import ProfileSettings
from filter_service.psf_build import build_psf_store
from filter_service.psf_grid import GridSpec


def check_profile(body: dict[str, Any], settings: ProfileSettings) -> EyeProfile:
    """Return the profile that a body describes.

    Raises
    ------
    UnknownProfile
        Names the field and what is allowed.
    """
    if settings.age_years is not None:
        body = body | {"age_years": settings.age_years}
    try:
        return parse_profile(body)
    except ValueError as error:
        field = getattr(error, "field", None)
        allowed = getattr(error, "allowed", None)
        # Field and limits travel in fields of their own.
        text = str(error).removeprefix(f"profile field '{field}': ")
        text = text.removesuffix(f"; allowed: {allowed}")
        raise UnknownProfile(text, field=field, allowed=allowed) from error


def build(
    job: BuildJob,
    *,
    progress: Callable[[float, str], None],
    cancelled: Callable[[], bool],
) -> BuiltStore:
    """Compute the PSF store of a job; runs in the worker process.

    Raises
    ------
    UnknownProfile, GridTooLarge, BuildFailed, BuildCancelled
    """
    started_s = time.perf_counter()
    profile = check_profile(job.body, job.settings)
    try:
        spec = GridSpec(
            pixel_pitch_mrad=job.pixel_pitch_mrad,
            pupil_range_mm=job.settings.pupil_range_mm,
            object_range_dpt=job.settings.object_range_dpt,
            focus_range_dpt=job.settings.focus_range_dpt,
            diffraction=job.settings.diffraction,
            chromatic=job.settings.chromatic,
            max_blur_radius_px=job.max_blur_radius_px,
        )
        eye, notes = prepare_eye(
            profile,
            spec,
            eye_model=job.settings.eye_model,
            progress=progress,
            cancelled=cancelled,
        )
        done = ABERRATION_SHARE if notes else 0.0
        store = build_psf_store(
            eye,
            spec,
            progress=lambda part, stage: progress(done + (1.0 - done) * part, stage),
            cancelled=cancelled,
        )
    except PsfTooLarge as error:
        raise GridTooLarge(
            str(error),
            field="settings.pupil_range_mm",
            allowed="a smaller pupil, nearer objects or fewer pixels per degree",
        ) from error
    except ValueError as error:  # the settings do not suit this eye or camera
        raise BuildFailed(str(error)) from error
    return BuiltStore(
        store=store,
        build_ms=1e3 * (time.perf_counter() - started_s),
        psf_count=store.psf_count,
        memory_mb=store.memory_mb,
        notes=notes,
    )
