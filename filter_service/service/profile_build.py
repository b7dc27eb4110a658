"""From a profile's body to its PSF stores: the work that the worker process does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from estimator.profiles import EyeProfile, parse_profile
from estimator.psf import PsfTooLarge
from filter_service.errors import (
    BuildCancelled,
    BuildFailed,
    GridTooLarge,
    UnknownProfile,
)
from filter_service.messages import ProfileSettings
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import PlanTooLarge, plan_cache
from filter_service.psfs.build import build_psf_store
from filter_service.psfs.engine import psf_engine
from filter_service.psfs.eye_model import ABERRATION_SHARE, prepare_eye
from filter_service.psfs.store_cache import StoreCache, Stored, store_key
from filter_service.service.build_job import BuildJob, BuiltStore
from filter_service.service.preview import is_worthwhile, preview_spec

PREVIEW_STAGE = "preview"

Progress = Callable[[float, str], None]


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


def grid_spec(job: BuildJob) -> GridSpec:
    """Return the grid that a job asks for."""
    settings = job.settings
    return GridSpec(
        camera=job.camera,
        pupil_range_mm=settings.pupil_range_mm,
        object_range_dpt=settings.object_range_dpt,
        focus_range_dpt=settings.focus_range_dpt,
        gaze_deg=settings.gaze_deg,
        gaze_range_deg=settings.gaze_range_deg,
        diffraction=settings.diffraction,
        chromatic=settings.chromatic,
        lateral_color=settings.lateral_color,
        mode=settings.mode,
        grid=settings.grid,
        tolerance=settings.tolerance,
        memory_budget_mb=job.limits.max_store_mb,
        max_blur_radius_px=job.limits.max_blur_radius_px,
    )


def build(
    job: BuildJob, *, progress: Progress, cancelled: Callable[[], bool]
) -> Iterator[BuiltStore]:
    """Compute the stores of a job: a preview where it helps, then the whole.

    Runs in the worker process.

    Raises
    ------
    UnknownProfile, GridTooLarge, BuildFailed, BuildCancelled
    """
    try:
        yield from _built(job, progress, cancelled)
    except PsfTooLarge as error:
        raise GridTooLarge(
            str(error),
            field="settings.pupil_range_mm",
            allowed="a smaller pupil, nearer objects or fewer pixels per degree",
        ) from error
    except PlanTooLarge as error:
        raise GridTooLarge(
            str(error), field="settings", allowed=f"{error.budget_mb:.0f} MB"
        ) from error
    except ValueError as error:  # the settings do not suit this eye or camera
        raise BuildFailed(str(error)) from error


def _built(
    job: BuildJob, progress: Progress, cancelled: Callable[[], bool]
) -> Iterator[BuiltStore]:
    started_s = time.perf_counter()

    def go_on() -> None:
        if cancelled():
            raise BuildCancelled("a newer profile took over")

    def result(store: Any, notes: tuple[str, ...], *, is_complete: bool) -> BuiltStore:
        return BuiltStore(
            store=store,
            build_ms=1e3 * (time.perf_counter() - started_s),
            psf_count=store.psf_count,
            memory_mb=store.memory_mb,
            notes=notes,
            is_complete=is_complete,
        )

    profile = check_profile(job.body, job.settings)
    spec, eye_model = grid_spec(job), job.settings.eye_model
    accuracy = job.settings.accuracy
    cache = StoreCache(job.limits.store_cache_dir, max_mb=job.limits.store_cache_max_mb)
    key = store_key(profile, spec, eye_model=eye_model, accuracy=accuracy)
    stored = cache.load(key, go_on=go_on)
    if stored is not None:
        notes = (*stored.notes, "PSFs from the disk cache")
        yield result(stored.store, notes, is_complete=True)
        return
    eye, notes = prepare_eye(
        profile,
        spec,
        eye_model=eye_model,
        accuracy=accuracy,
        progress=progress,
        cancelled=cancelled,
    )
    done = ABERRATION_SHARE if eye_model == "traced" else 0.0

    def report(part: float, stage: str) -> None:
        progress(done + (1.0 - done) * part, stage)

    go_on()
    engine = psf_engine(job.limits.psf_engine)
    # Over the field, planning the whole takes longer than a preview.
    plan = None if spec.follows_field else plan_cache(eye, spec)
    first_spec = preview_spec(spec, job.look_at)
    first_plan = plan_cache(eye, first_spec)
    if plan is None or is_worthwhile(
        preview_s=first_plan.prediction.build_s, whole_s=plan.prediction.build_s
    ):
        store = build_psf_store(
            eye,
            first_spec,
            plan=first_plan,
            engine=engine,
            progress=lambda part, stage: progress(done, PREVIEW_STAGE),
            cancelled=cancelled,
        )
        yield result(store, notes, is_complete=False)
    report(0.0, "plan")
    plan = plan or plan_cache(eye, spec)
    go_on()
    store = build_psf_store(
        eye, spec, plan=plan, engine=engine, progress=report, cancelled=cancelled
    )
    yield result(store, notes, is_complete=True)
    cache.save_aside(key, Stored(store, notes))
