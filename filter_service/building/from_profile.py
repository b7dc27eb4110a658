"""Build of an eye and the nodes of its PSFs from a profile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

from estimator.eye.checked_fields import ProfileError
from estimator.note import Note
from filter_service.building.eye_bank import BankedEye
from filter_service.building.jobs import BuildJob, BuiltStore, unknown_profile
from filter_service.errors import (
    BuildCancelled,
    BuildFailed,
    GridTooLarge,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import PlanAxes
from filter_service.planning.plan import PlanTooLarge, plan_axes, plan_cache
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.frame_layers import state_nodes
from filter_service.psfs.store import PsfStore, no_psfs
from filter_service.psfs.store_cache import StoreCache, Stored, store_key

Progress = Callable[[float, str], None]

EYE_SHARE = 0.25
"""Share of the eye in the duration of a build; the rest plans its nodes."""


def grid_spec(job: BuildJob) -> GridSpec:
    """Return the grid specification of a job."""
    return GridSpec(
        camera=job.camera,
        settings=job.settings,
        memory_budget_mb=job.limits.max_store_mb,
        max_blur_radius_px=job.limits.max_blur_radius_px,
    )


def build(
    job: BuildJob, *, progress: Progress, cancelled: Callable[[], bool]
) -> BuiltStore:
    """Estimate the eye of a job and plan its nodes, without computing PSFs.

    Runs in the worker process.

    Raises
    ------
    UnknownProfile, GridTooLarge, BuildFailed, BuildCancelled
    """
    try:
        return _built(job, progress, cancelled)
    except PlanTooLarge as error:
        raise GridTooLarge(
            str(error), field="settings", allowed=f"{error.budget_mb:.0f} MB"
        ) from error
    except ProfileError as error:  # light does not pass the eye
        raise unknown_profile(error) from error
    except ValueError as error:  # the settings do not suit this eye or camera
        field = getattr(error, "field", None)
        if field is None:  # raised by a computation, which knows no fields
            raise no_psfs(error) from error
        text = getattr(error, "message", str(error))
        allowed = getattr(error, "allowed", None)
        raise BuildFailed(text, field=field, allowed=allowed) from error


def _built(
    job: BuildJob, progress: Progress, cancelled: Callable[[], bool]
) -> BuiltStore:
    profile, spec = job.profile, grid_spec(job)
    if isinstance(profile, BankedEye):
        banked = profile.store(spec)
        return BuiltStore(banked, banked.notes)
    cache = StoreCache(job.limits.store_cache_dir, max_mb=job.limits.store_cache_max_mb)
    key = store_key(profile, spec)

    def check_cancelled() -> None:
        if cancelled():
            raise BuildCancelled("replaced by a newer profile")

    stored = cache.load(key, check_cancelled=check_cancelled)
    if stored is not None:
        notes = (*stored.notes, Note("eye_from_cache", "eye from the disk cache"))
        return _with_parts(job, PsfStore(**stored.parts), notes)
    eye, notes = eye_for_spec(
        profile,
        spec,
        progress=lambda done, stage: progress(EYE_SHARE * done, stage),
        cancelled=cancelled,
    )

    def report_plan(done: float) -> None:
        check_cancelled()
        progress(EYE_SHARE + (1.0 - EYE_SHARE) * done, "plan")

    report_plan(0.0)
    # The total memory of the PSFs is known only if all ranges are prepared at once;
    # otherwise nodes are planned when frames first read them.
    plan: PlanAxes
    if job.settings.prepare == "ranges":
        plan = plan_cache(eye, spec, progress=report_plan)
    else:
        plan = plan_axes(eye, spec, progress=report_plan)
    check_cancelled()
    store = PsfStore(eye, spec, plan)
    cache.save_aside(key, Stored(store.parts, notes))
    return _with_parts(job, store, notes)


def _with_parts(job: BuildJob, store: PsfStore, notes: tuple[str, ...]) -> BuiltStore:
    """Return a store with the nodes of the state of a job."""
    built = BuiltStore(store, notes)
    if job.near is None:
        return built
    count = len(state_nodes(store, job.near.clamped(job.settings)))
    return replace(built, parts=tuple(islice(built.parts_ahead(job), count)))
