"""From a profile's body to its PSF stores: the work that the worker process does."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfTooLarge
from filter_service.building.jobs import BuildJob, BuiltStore, Store
from filter_service.building.preview import is_worthwhile, preview_spec
from filter_service.building.read_profile import unknown_profile
from filter_service.constants import RGB
from filter_service.errors import (
    BuildCancelled,
    BuildFailed,
    GridTooLarge,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.part_of_plan import part_of_plan
from filter_service.planning.plan import (
    PlanTooLarge,
    check_budget,
    plan_cache,
    unchecked_plan,
)
from filter_service.psfs.build_store import (
    build_psf_store,
    compute_kernels,
    store_of,
)
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.kernel_shelf import KernelShelf
from filter_service.psfs.psf_engine import psf_engine
from filter_service.psfs.store import PsfStore
from filter_service.psfs.store_cache import StoreCache, Stored, store_key

PREVIEW_STAGE = "preview"

EYE_SHARE = 0.2
"""Progress at which the eye and its wavefronts are there."""

Progress = Callable[[float, str], None]


EYES_KEPT = 2
SHELF_MB = 600.0
"""Eyes that are kept for further parts of them, and the size of computed PSFs from
which those of an eye are let go: a stream comes back for more."""


@dataclass
class _KnownEye:
    """An eye over all the ranges of its job, and what was made of it."""

    eye: EyeOptics
    notes: tuple[str, ...]
    plan: CachePlan | None = None
    shelf: KernelShelf | None = None


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
        raise BuildFailed(str(error)) from error


def _known_eye(
    job: BuildJob, *, progress: Progress, cancelled: Callable[[], bool]
) -> _KnownEye:
    """Return the eye of a job, made once for all parts of its ranges."""
    whole = grid_spec(job, whole=True)
    key = store_key(job.profile, whole)
    if key not in _eyes:
        _eyes[key] = _KnownEye(
            *eye_for_spec(job.profile, whole, progress=progress, cancelled=cancelled)
        )
    _eyes.move_to_end(key)
    while len(_eyes) > EYES_KEPT:
        _eyes.popitem(last=False)
    return _eyes[key]


def _planned(job: BuildJob, known: _KnownEye) -> tuple[CachePlan, NDArray[np.int64]]:
    """Return the plan of a job, and which nodes of the plan of all ranges it has.

    Raises
    ------
    PlanTooLarge
    """
    spec, whole = grid_spec(job), grid_spec(job, whole=True)
    if job.ranges is None:
        plan = plan_cache(known.eye, spec)
        return plan, np.arange(len(plan.defocus.values_dpt))
    if known.plan is None:
        known.plan = unchecked_plan(known.eye, whole)
    plan, nodes = part_of_plan(known.plan, known.eye, spec)
    check_budget(known.eye, spec, plan)
    return plan, nodes


def _store(
    job: BuildJob,
    known: _KnownEye,
    plan: CachePlan,
    nodes: NDArray[np.int64],
    **options: Any,
) -> PsfStore:
    """Compute what is missing of the store of a plan."""
    spec, started_s = grid_spec(job), time.perf_counter()
    if job.ranges is None or known.plan is None:
        return build_psf_store(known.eye, spec, plan=plan, **options)
    if known.shelf is None or known.shelf.memory_mb > SHELF_MB:
        channels = RGB if spec.settings.chromatic else 1
        known.shelf = KernelShelf(len(known.plan.defocus.values_dpt), channels)
    missing = known.shelf.missing(nodes)
    if missing.size:
        kernels = compute_kernels(known.eye, spec, known.plan, missing, **options)
        known.shelf.put(missing, kernels)
    return store_of(
        spec,
        known.eye,
        plan,
        known.shelf.kernels(nodes),
        build_ms=1e3 * (time.perf_counter() - started_s),
    )


def _built(
    job: BuildJob, progress: Progress, cancelled: Callable[[], bool]
) -> Iterator[BuiltStore]:
    started_s = time.perf_counter()

    def go_on() -> None:
        if cancelled():
            raise BuildCancelled("a newer profile took over")

    def result(
        store: Store, notes: tuple[str, ...], *, is_complete: bool
    ) -> BuiltStore:
        return BuiltStore(
            store=store,
            build_ms=1e3 * (time.perf_counter() - started_s),
            psf_count=store.psf_count,
            memory_mb=store.memory_mb,
            notes=notes,
            is_complete=is_complete,
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
    known = _known_eye(
        job,
        progress=lambda part, stage: progress(EYE_SHARE * part, stage),
        cancelled=cancelled,
    )
    eye, notes = known.eye, known.notes
    done = 0.0 if job.settings.eye_model == "wavefront" else EYE_SHARE

    def report(part: float, stage: str) -> None:
        progress(done + (1.0 - done) * part, stage)

    go_on()
    engine = psf_engine(job.limits.psf_engine)
    # Over the field, planning the whole takes longer than a preview.
    planned = None if spec.follows_field else _planned(job, known)
    if job.with_preview:
        first_spec = preview_spec(spec, job.look_at)
        first_plan = plan_cache(eye, first_spec)
        if planned is None or is_worthwhile(
            preview_s=first_plan.prediction.build_s,
            whole_s=planned[0].prediction.build_s,
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
    plan, nodes = planned or _planned(job, known)
    go_on()
    store = _store(
        job, known, plan, nodes, engine=engine, progress=report, cancelled=cancelled
    )
    yield result(store, notes, is_complete=True)
    cache.save_aside(key, Stored(store, notes))
