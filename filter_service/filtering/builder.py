"""Builder: prepares the eyes of all streams of a process.

The build worker estimates the eye of a profile, the engine loads it, and the PSFs of a
first frame are computed in small batches between frames.  Streams receive events.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.building.jobs import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildJob,
    BuildLimits,
    BuildPart,
    BuildProgress,
)
from filter_service.building.worker_handle import InlineWorker, WorkerHandle
from filter_service.camera import Camera
from filter_service.errors import (
    BuildCancelled,
    FilterError,
    RenderFailed,
)
from filter_service.filtering.stream_eyes import (
    AcceptedProfile,
    BuildingEye,
    BuildTarget,
    EyeFailed,
    EyeReady,
    PreparedStore,
    StreamEyes,
)
from filter_service.rendering.engine import FrameEngine, LoadedStore
from filter_service.rendering.frame_kernels import first_frame
from filter_service.settings import FilterSettings
from filter_service.view_state import State

MS_PER_S = 1e3

EYE_PROGRESS = 0.3
"""Progress at which the eye is estimated and the nodes of its PSFs are known."""

EVICTION_SHARE = 0.8
"""Eviction reduces an eye's PSFs to this share of its limit, so that it is rare."""

FIRST_RANGE_S, FIRST_SHARE = (0.004, 0.08), 1.0
"""Time between two frames for the first PSFs of a new eye: this share of a frame's
duration, within the range.  During a stream of 1280x720 that takes both cores, with a
worker of niceness 0, new eyes appeared after 0.7 to 1.5 s; with half of the time, and
at most 0.03 s, after 1.1 to 2.5 s."""

AHEAD_RANGE_S, AHEAD_SHARE = (0.004, 0.03), 0.5
"""The same for predicted PSFs: half of a frame's duration, so that they never delay a
stream by a whole frame."""

WARM_BATCH = 256
"""PSFs per batch, 5 ms on two cores; the deadline is checked after each batch."""

CHECK_GROWTH = 4
"""Factor by which each check allows more missing PSFs than the last, from `WARM_BATCH`
on.  A new eye is ready once a check finds no more than allowed; a pupil that keeps
moving needs new PSFs at every check."""

BUSY_SHARE = 0.4
"""If frames take more than this share of the frame interval, no PSFs are predicted.  At
0.8, on two cores, 26 to 52 % of the frames were complete instead of 49 to 73: the next
frame waited for the current batch."""

PROGRESS_INTERVAL_S = 0.1
"""Minimum interval between two progress events of an eye."""

log = logging.getLogger("ocufilter")


class Builder:
    """Builds eyes in the build worker, and computes PSFs before frames need them.

    Parameters
    ----------
    worker : WorkerHandle
        Build worker, started by the first `advance` if necessary; closed by `close`.
    engine : FrameEngine
    limits : BuildLimits
    engine_name : str
        Name of the engine in the settings.
    """

    def __init__(
        self,
        worker: WorkerHandle | InlineWorker,
        engine: FrameEngine,
        limits: BuildLimits,
        *,
        engine_name: str = "",
    ) -> None:
        self.worker = worker
        self.engine = engine
        self.engine_name = engine_name
        self.streams: list[StreamEyes] = []
        self.frame_s = 0.0  # duration of the last frame
        self.n_advances = 0  # of builds and of first PSFs: it changes as they advance
        self._last_progress: BuildProgress | None = None
        self._limits = limits
        self._released: list[Any] = []
        self._dropping: list[Any] = []
        self._is_warming = False

    @property
    def stores_mb(self) -> float:
        """Return the memory of all streams' PSFs, 10^6 bytes."""
        return sum(prepared.store.memory_mb for prepared in self._prepared())

    def _prepared(self) -> list[PreparedStore]:
        return [
            prepared
            for stream in self.streams
            for eye in stream.eyes
            for prepared in eye.stores
        ]

    @property
    def is_warming(self) -> bool:
        """Return whether `advance` has work that does not wait for an event."""
        return self._is_warming

    def accept(
        self,
        stream: StreamEyes,
        profile: EyeProfile,
        settings: FilterSettings,
        cameras: Sequence[Camera] = (),
        *,
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Accept a profile; cancel an older one that is not ready.

        The parameters are those of `StreamEyes.add_profile`.
        """
        # Also one whose build has not started: its sender expects an outcome.
        building = stream.building
        replaced = [building.eye] if building is not None else []
        unfinished = stream.unfinished_eye()
        if unfinished is not None and unfinished not in replaced:
            replaced.append(unfinished)
        self.cancel(stream)
        for old in replaced:
            newer = "a newer profile" if profile_id is None else f"profile {profile_id}"
            error = BuildCancelled(f"{newer} replaced profile {old.profile_id}")
            stream.on_event(EyeFailed(old, error))
        eye = stream.add_profile(profile, settings, cameras, profile_id=profile_id)
        self.free_retired(stream)
        return eye

    def end(self, stream: StreamEyes) -> None:
        """End a stream and release its eyes."""
        if stream in self.streams:
            self.streams.remove(stream)
        self.cancel(stream)
        stream.end()
        stream.begun.clear()
        self.free_retired(stream)

    def close(self) -> None:
        """End all streams and close the worker."""
        for stream in list(self.streams):
            self.end(stream)
        self.worker.close()

    def cancel(self, stream: StreamEyes) -> None:
        """Cancel the current build of a stream, if there is one."""
        if stream.ticket is not None:
            self.worker.cancel(stream.ticket)
        stream.ticket = stream.building = None

    def free_retired(self, stream: StreamEyes) -> None:
        """Free the stores that a stream has retired, unless frames are unfinished."""
        if stream.begun:
            return
        for store in stream.retired:
            store.release()
        self._released += stream.retired
        stream.retired = []

    def _drop_released(self) -> None:
        """Free released stores in a thread, one iteration later.

        Returning half a gigabyte to the system takes 0.2 s.  By the next iteration the
        renderer has dropped its references.
        """
        dropped, self._dropping = self._dropping, self._released
        self._released = []
        if dropped:
            threading.Thread(target=dropped.clear, daemon=True).start()

    def advance(self, *, ahead: bool = True) -> None:
        """Process the worker's events, then compute PSFs for a limited time.

        `FIRST_SHARE` and `AHEAD_SHARE` define the limits.

        Parameters
        ----------
        ahead : bool
            Whether to also compute predicted PSFs of eyes in use; otherwise only PSFs
            of new eyes.
        """
        self._drop_released()
        for event in self.worker.poll():
            self._count_advance(event)
            if isinstance(event, BuildPart):
                self._add_part(event)
                continue
            stream = next((s for s in self.streams if s.ticket == event.ticket), None)
            # If there is none, the stream has ended or has a newer profile.
            if stream is not None:
                self._handle(stream, event)
        for stream in list(self.streams):
            following = stream.next_build()
            if stream.building is None and following is not None:
                stream.building = following
                stream.ticket = self.worker.submit(
                    BuildJob(
                        profile=following.eye.profile,
                        settings=following.eye.settings,
                        camera=following.camera,
                        limits=self._limits,
                        near=_likely_state(stream, following),
                    )
                )
        self._warm_first_frames()
        if ahead:
            self._warm_ahead_of_streams()
        self._limit_memory()

    def _count_advance(self, event: BuildEvent) -> None:
        """Count an event, unless a build reports the same progress again."""
        if isinstance(event, BuildProgress):
            if event == self._last_progress:
                return
            self._last_progress = event
        self.n_advances += 1

    def _handle(self, stream: StreamEyes, event: BuildEvent) -> None:
        if stream.building is None:
            return  # a late event of a canceled build
        target = stream.building
        if isinstance(event, BuildProgress):
            fraction = EYE_PROGRESS * event.fraction
            self._report(stream, target.eye, fraction, event.stage)
        elif isinstance(event, BuildDone):
            stream.ticket = stream.building = None
            try:
                loaded = self.engine.load(event.built.store)
            except Exception as error:
                self._fail(stream, target, _to_filter_error(error))
                return
            prepared = PreparedStore(
                *(target.camera, loaded, target.eye.accepted_s, event.built.notes),
                ticket=event.ticket,
            )
            stream.add_store(target.eye, prepared)
            self.free_retired(stream)
        elif isinstance(event, BuildError):
            self._fail(stream, target, event.error)

    def _add_part(self, event: BuildPart) -> None:
        """Add a part from the worker to its store, if that still exists."""
        for prepared in self._prepared():
            if prepared.ticket == event.ticket:
                prepared.store.add_part(event.part)

    # PSFs that are computed before frames need them

    def _share_of_frame_s(self, share: float, range_s: tuple[float, float]) -> float:
        """Return a share of a frame's duration, within a range."""
        low_s, high_s = range_s
        return min(max(share * self.frame_s, low_s), high_s)

    def _warm_first_frames(self) -> None:
        """Compute PSFs of new eyes' first frames, for a limited time."""
        until_s = time.monotonic() + self._share_of_frame_s(FIRST_SHARE, FIRST_RANGE_S)
        self._is_warming = False
        for stream in list(self.streams):
            while (found := stream.store_to_warm()) is not None:
                is_over = self._warm_first(stream, *found, until_s)
                _, prepared = found
                n_computed = prepared.store.computed_count
                # Not those that were evicted and are computed again, without end.
                if n_computed > prepared.n_most_computed:
                    prepared.n_most_computed = n_computed
                    self.n_advances += 1
                if time.monotonic() > until_s:
                    self._is_warming |= not is_over
                    break

    def _warm_ahead_of_streams(self) -> None:
        """Compute predicted PSFs of eyes in use, for a limited time."""
        until_s = time.monotonic() + self._share_of_frame_s(AHEAD_SHARE, AHEAD_RANGE_S)
        for stream in self.streams:
            if self._is_warming or time.monotonic() > until_s:
                return
            if stream.store_to_warm() is None:
                self._warm_ahead(stream, until_s)

    def _warm_first(
        self,
        stream: StreamEyes,
        eye: AcceptedProfile,
        prepared: PreparedStore,
        until_s: float,
    ) -> bool:
        """Compute the PSFs of a first frame; return whether the store is finished."""
        store, use = prepared.store, stream.history.last
        is_all = eye.settings.prepare == "ranges"
        try:
            if not prepared.pending.size:
                use = use or first_frame(prepared.camera, eye.settings)
                prepared.pending = store.missing_psfs(None if is_all else use)
                if prepared.pending.size:
                    self._report_progress(stream, eye, prepared)
            n_pending = prepared.pending.size
            if n_pending:
                left = store.fill(
                    prepared.pending, until_s=until_s, batch_count=WARM_BATCH
                )
                if left.size:
                    self._report_progress(stream, eye, prepared)
                    return False
                prepared.pending = left
                # Pupil and focus may have changed meanwhile, so check again.
                prepared.n_checks += 1
                if n_pending > WARM_BATCH * CHECK_GROWTH ** (prepared.n_checks - 1):
                    return False
        except Exception as error:  # must not affect other streams
            target = BuildTarget(eye, prepared.camera)
            self._fail(stream, target, _to_filter_error(error))
            return True
        self._set_ready(stream, eye, prepared)
        return True

    def _report_progress(
        self, stream: StreamEyes, eye: AcceptedProfile, prepared: PreparedStore
    ) -> None:
        now_s = time.monotonic()
        if now_s < prepared.next_progress_s:
            return
        prepared.next_progress_s = now_s + PROGRESS_INTERVAL_S
        n_computed = prepared.store.computed_count
        share = n_computed / (n_computed + prepared.pending.size)
        fraction = EYE_PROGRESS + (1.0 - EYE_PROGRESS) * share
        self._report(stream, eye, fraction, "psfs")

    def _report(
        self, stream: StreamEyes, eye: AcceptedProfile, fraction: float, stage: str
    ) -> None:
        eye.fraction, eye.stage = fraction, stage
        stream.on_event(BuildingEye(eye, fraction, stage))

    def mark_rendered(
        self, stream: StreamEyes, eye: AcceptedProfile, store: LoadedStore
    ) -> None:
        """Mark the store that a view was rendered with as ready."""
        for prepared in list(eye.stores):
            if not prepared.is_ready and prepared.store is store:
                self._set_ready(stream, eye, prepared)

    def _set_ready(
        self, stream: StreamEyes, eye: AcceptedProfile, prepared: PreparedStore
    ) -> None:
        stream.set_ready(eye, prepared)
        stream.on_event(
            EyeReady(
                eye,
                prepared.camera,
                build_ms=MS_PER_S * (time.monotonic() - prepared.started_s),
                psf_count=prepared.store.computed_count,
                memory_mb=prepared.store.memory_mb,
                notes=prepared.notes,
            )
        )

    def _warm_ahead(self, stream: StreamEyes, until_s: float) -> None:
        """Compute the PSFs of a stream's predicted states."""
        prepared, last = stream.store_in_use(), stream.history.last
        if prepared is None or last is None or last is stream.history.last_warmed:
            return
        if self.frame_s > BUSY_SHARE * stream.history.interval_s:
            return
        store = prepared.store
        try:
            for state in stream.history.predicted_states():
                left = store.missing_psfs(last, state=state)
                if left.size:
                    left = store.fill(left, until_s=until_s, batch_count=WARM_BATCH)
                if left.size:
                    self._is_warming = True
                    return
        except Exception as error:  # a frame that needs the PSFs reports it
            log.info(
                "predicted PSFs could not be computed: %s", _to_filter_error(error)
            )
        stream.history.last_warmed = last

    def _limit_memory(self) -> None:
        """Evict PSFs of the least recently used eyes beyond ``max_stores_mb``."""
        excess_mb = self.stores_mb - self._limits.max_stores_mb
        for prepared in sorted(
            self._prepared(), key=lambda prepared: prepared.last_used_s
        ):
            if excess_mb <= 0.0:
                return
            before_mb = prepared.store.memory_mb
            prepared.store.evict(EVICTION_SHARE * max(before_mb - excess_mb, 0.0))
            excess_mb -= before_mb - prepared.store.memory_mb

    def _fail(
        self, stream: StreamEyes, target: BuildTarget, error: FilterError
    ) -> None:
        """Record and report that an eye cannot be prepared for a camera."""
        self.cancel(stream)
        stream.fail_build(target.eye, target.camera, error)
        self.free_retired(stream)
        stream.on_event(EyeFailed(target.eye, error))


def _likely_state(stream: StreamEyes, target: BuildTarget) -> State:
    """Return the likely pupil and focus of the next frame."""
    use = stream.history.last or first_frame(target.camera, target.eye.settings)
    return use.state


def _to_filter_error(error: Exception) -> FilterError:
    """Return an error for clients; log an unexpected one."""
    if isinstance(error, FilterError):
        return error
    log.error("an eye could not be prepared", exc_info=error)
    return RenderFailed(f"{type(error).__name__}: {error}")
