"""From a profile's body to its PSF stores: the work that the worker process does."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator

from estimator.eye.checked_fields import ProfileError
from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfTooLarge
from filter_service.building.jobs import BuildJob, BuiltStore, Store
from filter_service.building.preview import is_worthwhile, preview_ranges, preview_spec
from filter_service.building.read_profile import unknown_profile
from filter_service.building.used_ranges import UsedRanges
from filter_service.errors import (
    BuildCancelled,
    BuildFailed,
    GridTooLarge,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import (
    PlanTooLarge,
    plan_cache,
)
from filter_service.psfs.build_store import (
    build_psf_store,
)
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.psf_engine import psf_engine
from filter_service.psfs.store_cache import StoreCache, Stored, store_key

PREVIEW_STAGE = "preview"

EYE_SHARE = 0.2
"""Progress at which the eye and its wavefronts are there."""

Progress = Callable[[float, str], None]


EYES_KEPT = 2
"""A stream comes back for other parts of its eye."""

_KnownEye = tuple[EyeOptics, tuple[str, ...]]

_eyes: OrderedDict[str, _KnownEye] = OrderedDict()


def grid_spec(job: BuildJob, *, whole: bool = False) -> GridSpec:
    """Return the grid that a job asks for, or the one that all its ranges make."""
    settings = job.settings
    if job.ranges is not None and not whole:
        settings = job.ranges.applied(settings)
    return GridSpec(
        camera=job.camera,
        settings=settings,
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
    except ProfileError as error:  # light does not pass a given eye
        raise unknown_profile(error) from error
    except ValueError as error:  # the settings do not suit this eye or camera
        field = getattr(error, "field", None)
        if field is None:  # of a computation, which knows nothing of fields
            raise BuildFailed(
                f"no PSFs can be computed for this eye ({error})",
                field="settings",
                allowed="ranges, and a camera, that this eye can be seen through",
            ) from error
        text = getattr(error, "message", str(error))
        allowed = getattr(error, "allowed", None)
        raise BuildFailed(text, field=field, allowed=allowed) from error


def _known_eye(
    job: BuildJob, *, progress: Progress, cancelled: Callable[[], bool]
) -> _KnownEye:
    """Return the eye of a job and notes, made once for all parts of its ranges."""
    whole = grid_spec(job, whole=True)
    key = store_key(job.profile, whole)
    if key not in _eyes:
        _eyes[key] = eye_for_spec(
            job.profile, whole, progress=progress, cancelled=cancelled
        )
    _eyes.move_to_end(key)
    while len(_eyes) > EYES_KEPT:
        _eyes.popitem(last=False)
    return _eyes[key]


def _built(
    job: BuildJob, progress: Progress, cancelled: Callable[[], bool]
) -> Iterator[BuiltStore]:
    started_s = time.perf_counter()

    def go_on() -> None:
        if cancelled():
            raise BuildCancelled("a newer profile took over")

    def result(
        store: Store,
        notes: tuple[str, ...],
        *,
        is_complete: bool,
        ranges: UsedRanges | None = None,
    ) -> BuiltStore:
        return BuiltStore(
            store=store,
            build_ms=1e3 * (time.perf_counter() - started_s),
            psf_count=store.psf_count,
            memory_mb=store.memory_mb,
            notes=notes,
            is_complete=is_complete,
            ranges=ranges,
        )

    profile = job.profile
    spec = grid_spec(job)
    cache = StoreCache(job.limits.store_cache_dir, max_mb=job.limits.store_cache_max_mb)
    key = store_key(profile, spec)
    stored = cache.load(key, go_on=go_on)
    if stored is not None:
        notes = (*stored.notes, "PSFs from the disk cache")
        yield result(stored.store, notes, is_complete=True)
        return
    eye, notes = _known_eye(
        job,
        progress=lambda part, stage: progress(EYE_SHARE * part, stage),
        cancelled=cancelled,
    )
    done = 0.0 if job.settings.eye_model == "wavefront" else EYE_SHARE

    def report(part: float, stage: str) -> None:
        progress(done + (1.0 - done) * part, stage)

    go_on()
    engine = psf_engine(job.limits.psf_engine)
    # Over the field, planning the whole takes longer than a preview.
    plan = None if spec.follows_field else plan_cache(eye, spec)
    if job.with_preview:
        first_spec = preview_spec(spec, job.look_at)
        first_plan = plan_cache(eye, first_spec)
        if plan is None or is_worthwhile(
            preview_s=first_plan.prediction.build_s,
            whole_s=plan.prediction.build_s,
        ):
            store = build_psf_store(
                eye,
                first_spec,
                plan=first_plan,
                engine=engine,
                progress=lambda part, stage: progress(done, PREVIEW_STAGE),
                cancelled=cancelled,
            )
            good_for = preview_ranges(first_spec)
            yield result(store, notes, is_complete=False, ranges=good_for)
    report(0.0, "plan")
    plan = plan or plan_cache(eye, spec)
    go_on()
    store = build_psf_store(
        eye, spec, plan=plan, engine=engine, progress=report, cancelled=cancelled
    )
    yield result(store, notes, is_complete=True)
    cache.save_aside(key, Stored(store, notes))
