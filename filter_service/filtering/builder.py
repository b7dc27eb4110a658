"""Builder: prepares the eyes of all streams of a process.

The build worker estimates the eye of a profile, the engine loads it, and a thread
computes the PSFs of a first frame, and later those of predicted states.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.blas_threads import one_blas_thread
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
from filter_service.filtering.priority_lock import PriorityLock, Signal
from filter_service.filtering.psf_work import (
    PsfWork,
    first_psfs,
    likely_state,
    predicted_work,
)
from filter_service.filtering.store_load import StoreLoad
from filter_service.filtering.stream_eyes import (
    AcceptedProfile,
    BuildingEye,
    BuildTarget,
    EyeEvent,
    EyeFailed,
    EyeReady,
    PreparedStore,
    Preparing,
    StreamEyes,
)
from filter_service.heap import trim_heap
from filter_service.rendering.engine import FrameEngine
from filter_service.rendering.frame_states import FrameStore
from filter_service.settings import FilterSettings

MS_PER_S = 1e3

EYE_PROGRESS = 0.3
"""Progress at which the eye is estimated and the nodes of its PSFs are known."""

EVICTION_SHARE = 0.8
"""Eviction reduces an eye's PSFs to this share of its limit, so that it is rare."""

STEP_LIMIT_S, PAUSE_LIMIT_S = 0.04, 0.08
"""Longest times that a frame waits for the next step of the thread, and that it pauses
for its steps."""

CHECK_LIMIT, CHECK_GROWTH = 256, 4
"""Number of missing PSFs that the second check allows, and the factor by which each
later one allows more.  A pupil that keeps moving needs new PSFs at every check."""

FIRST_SHARES, PSF_S = (0.35, 1.0), 1.5e-5
"""The first frame through a new eye may compute PSFs in these shares of its duration:
of those that the first check found, and of those that later ones find, because pupil
and focus move on.  Each takes so much time on two cores, a third of the time that the
thread takes beside frames."""

BUSY_SHARE = 0.4
"""If frames take more than this share of the frame interval, PSFs are predicted only
for states that read other nodes than the last frame."""

PROGRESS_INTERVAL_S = 0.1
"""Minimum interval between two progress events of an eye."""

TRIM_AFTER_S = 0.5
"""Delay after which freed memory is returned to the system, which takes 1 to 10 ms."""

IDLE_WAIT_S, RESTART_WAIT_S = 0.5, 0.1  # for the worker's message, or its start

log = logging.getLogger("ocufilter")


class Builder:
    """Builds eyes in the build worker, and computes PSFs before frames need them.

    A thread does both, from the first profile on.  It and the calls of the builder's
    methods exclude each other, except while the thread computes PSFs.  It uses no
    OpenGL, and no events are delivered in it.

    Parameters
    ----------
    worker : WorkerHandle or InlineWorker
        Build worker, closed by `close`.  With one that has no process, there is no
        thread; eyes are then prepared in `await_event`.
    engine : FrameEngine
    limits : BuildLimits
    engine_name : str
        Name of the engine in the settings.

    Attributes
    ----------
    wakes_after_frames : bool
        Whether a frame wakes the thread when it ends; otherwise, the caller calls
        `prepare` once it has passed the result on.
    has_events : object with a descriptor
        It can be read from when there are events for `deliver_all`.
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
        self.wakes_after_frames = True
        self.has_events = Signal()
        self._last_progress: BuildProgress | None = None
        self._limits = limits
        self._released: list[Any] = []
        self._dropping: list[Any] = []
        self._trim_at_s: float | None = None
        self._loads: deque[StoreLoad] = deque()
        self._thread: threading.Thread | None = None
        self._is_closed = False
        self._wake = Signal()
        self._lock = PriorityLock()

    @property
    def stores_mb(self) -> float:
        """Return the memory of all streams' PSFs, 10^6 bytes."""
        return sum(prepared.store.memory_mb for prepared in self._prepared())

    @property
    def tables_mb(self) -> float:
        """Return the memory of the tables of all streams' PSFs, 10^6 bytes."""
        return sum(prepared.store.tables_mb for prepared in self._prepared())

    def _prepared(self) -> list[PreparedStore]:
        return [
            prepared
            for stream in self.streams
            for eye in stream.eyes
            for prepared in eye.stores
        ]

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Exclude preparation while a frame is begun, after a step that is due."""
        self._lock.let_thread_step(STEP_LIMIT_S)
        with self.exclusive():
            yield

    def exclusive(self) -> AbstractContextManager[None]:
        """Exclude preparation during a call, which goes first."""
        return self._lock.foreground()

    def end_frame(self, stream: StreamEyes, duration_s: float) -> None:
        """Note that a frame was rendered, and deliver the events of its stream."""
        self.frame_s = duration_s
        if self.wakes_after_frames:
            self._wake.set()
        self.deliver(stream)

    @contextmanager
    def as_one_frame(self) -> Iterator[None]:
        """Treat the frames in this block, of several streams, as one.

        The thread waits for the end of the block.  After each of eleven frames, its
        search for predicted PSFs took a quarter of the time of an image of 31 bands.
        """
        wakes, self.wakes_after_frames = self.wakes_after_frames, False
        started_s = time.monotonic()
        try:
            yield
        finally:
            self.wakes_after_frames = wakes
            self.frame_s = time.monotonic() - started_s
            if wakes:
                self._wake.set()

    def let_thread_work(self) -> None:
        """Let the thread work during a frame that pauses, if it has anything to do."""
        self._lock.pause(PAUSE_LIMIT_S)

    def trim(self) -> None:
        """Release buffers of the engine after an idle period."""
        with self.exclusive():
            self.engine.trim()

    def _emit(self, stream: StreamEyes, event: EyeEvent) -> None:
        if isinstance(event, BuildingEye):
            event.eye.fraction, event.eye.stage = event.fraction, event.stage
        stream.events.put(event)
        self.has_events.set()

    def deliver(self, stream: StreamEyes, timeout_s: float = 0.0) -> None:
        """Call a stream's ``on_event`` with its events, in the caller's thread.

        Parameters
        ----------
        timeout_s : float
            Longest time to wait for the first event.
        """
        self.free_retired(stream)
        if not timeout_s and stream.events.empty():
            return
        with suppress(queue.Empty):
            while True:
                event = stream.events.get(timeout=timeout_s)
                timeout_s = 0.0
                stream.on_event(event)

    def deliver_all(self) -> None:
        """Deliver the events of all streams."""
        self.has_events.clear()
        for stream in list(self.streams):
            self.deliver(stream)

    def await_event(self, stream: StreamEyes, timeout_s: float = 0.0) -> None:
        """Wait for an event of a stream and deliver it.

        Without a thread, this prepares eyes for a moment.
        """
        if not self.worker.has_process:
            with one_blas_thread():
                work, has_more = self._step()
                if work is not None:
                    work.compute(self._lock, lambda: False)
                    self._next_work()
            if has_more:
                timeout_s = 0.0
        self.deliver(stream, timeout_s)

    def prepare(self) -> None:
        """Let the thread look for new work; start it if there is none."""
        if self._thread is None and self.worker.has_process:
            self._thread = threading.Thread(
                target=self._run, name="preparer", daemon=True
            )
            self._thread.start()
        self._wake.set()

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

        The parameters are the same as for `StreamEyes.add_profile`.
        """
        with self.exclusive():
            # Also one whose build has not started: its sender expects an outcome.
            building = stream.building
            replaced = [building.eye] if building is not None else []
            unfinished = stream.unfinished_eye()
            if unfinished is not None and unfinished not in replaced:
                replaced.append(unfinished)
            self._cancel(stream)
            newer = "a newer profile" if profile_id is None else f"profile {profile_id}"
            for old in replaced:
                error = BuildCancelled(f"{newer} replaced profile {old.profile_id}")
                self._emit(stream, EyeFailed(old, error))
            eye = stream.add_profile(profile, settings, cameras, profile_id=profile_id)
            self._submit(stream)
            # Only events so far: those of the new eye follow the caller's reply.
            self.deliver(stream)
        self.prepare()
        return eye

    def plan(
        self,
        stream: StreamEyes,
        cameras: Sequence[Camera],
        *,
        newest_only: bool = False,
    ) -> tuple[AcceptedProfile, list[FrameStore]] | Preparing:
        """Return the eye and the store of each view; see `StreamEyes.plan`."""
        self.await_event(stream)
        with self.exclusive():
            plan = stream.plan(cameras, newest_only=newest_only)
            has_work = stream.next_build() is not None
        if has_work:  # otherwise predictions would go before the frame
            self.prepare()
        self.free_retired(stream)
        return plan

    def end(self, stream: StreamEyes) -> None:
        """End a stream and release its eyes."""
        with self.exclusive():
            if stream in self.streams:
                self.streams.remove(stream)
            self._cancel(stream)
            stream.end()
            stream.begun.clear()
        self.free_retired(stream)
        self._wake.set()

    def close(self) -> None:
        """End the thread and all streams, and close the worker."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._thread is not None:
            self._wake.set()
            self._thread.join()
        for stream in list(self.streams):
            self.end(stream)
        self.worker.close()
        self._wake.close()
        self.has_events.close()

    def _cancel(self, stream: StreamEyes) -> None:
        """Cancel the current build of a stream, if there is one."""
        if stream.ticket is not None:
            self.worker.cancel(stream.ticket)
        stream.ticket = stream.building = None

    def free_retired(self, stream: StreamEyes) -> None:
        """Free the stores that a stream has retired, unless frames are unfinished."""
        if stream.begun or not stream.retired:
            return
        with self.exclusive():
            retired, stream.retired = stream.retired, []
            for store in retired:
                store.release()
            if self._thread is not None:
                self._released += retired
        self._wake.set()

    def _run(self) -> None:
        """Prepare eyes until the builder is closed."""
        while not self._is_closed:
            with self._lock.background() as may_work:
                if not may_work:
                    continue
                work, has_more = None, False
                try:
                    work, has_more = self._step()
                except Exception:  # must not end the preparation of other eyes
                    log.exception("eyes could not be prepared")
                if not has_more or work is not None:
                    self._lock.resume()
            if work is not None:
                work.compute(self._lock, lambda: self._is_closed)
            if self._drop_released() or has_more:
                continue
            self._trim_heap()
            worker = self.worker.file_descriptor
            watched: list[Any] = [self._wake, *([] if worker is None else [worker])]
            wait(watched, RESTART_WAIT_S if self.worker.needs_poll else IDLE_WAIT_S)
            self._wake.clear()

    def _drop_released(self) -> bool:
        """Drop released stores, one iteration later; return whether any are left.

        Returning half a gigabyte to the system takes 0.2 s.  By the next iteration the
        renderer has dropped its references.
        """
        if self._dropping:
            self._trim_at_s = time.monotonic() + TRIM_AFTER_S
        self._dropping, self._released = self._released, []
        return bool(self._dropping)

    def _trim_heap(self) -> None:
        """Return to the system what an eye took, once its successor is in use.

        Between 50 and 90 MB of each eye would stay in the heap at 1280x720.
        """
        if self._trim_at_s is not None and time.monotonic() > self._trim_at_s:
            self._trim_at_s = None
            trim_heap()

    def _step(self) -> tuple[PsfWork | StoreLoad | None, bool]:
        """Process the worker's events, and add what was computed.

        Returns what to compute next, and whether there is more to do after that.
        """
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
            self._submit(stream)
        found = self._next_work()
        self._limit_memory()
        return found

    def _next_work(self) -> tuple[PsfWork | StoreLoad | None, bool]:
        """Add what was computed; return what to compute next, as `_step`."""
        if self._loads and self._loads[0].is_done:
            self._add_loaded(self._loads.popleft())
        if self._loads:
            return self._loads[0], True
        found, work = self._to_warm(), None
        if found is not None:
            self._warm_first(*found)
            _, _, prepared = found
            work = prepared.work
            n_computed = prepared.store.computed_count
            # Not those that were evicted and are computed again, without end.
            if n_computed > prepared.n_most_computed:
                prepared.n_most_computed = n_computed
                self.n_advances += 1
        else:
            works = map(self._warm_ahead, list(self.streams))
            work = next((one for one in works if one is not None), None)
        return work, found is not None or work is not None

    def _submit(self, stream: StreamEyes) -> None:
        """Submit the next build of a stream to the worker, unless one is running."""
        following = stream.next_build()
        if stream.building is not None or following is None:
            return
        stream.building = following
        stream.ticket = self.worker.submit(
            BuildJob(
                profile=following.eye.profile,
                settings=following.eye.settings,
                camera=following.camera,
                limits=self._limits,
                near=likely_state(
                    following.camera, following.eye.settings, stream.history
                ),
            )
        )

    def _to_warm(self) -> tuple[StreamEyes, AcceptedProfile, PreparedStore] | None:
        """Return a stream, its newest eye and a store of that that is not ready."""
        for stream in list(self.streams):
            found = stream.store_to_warm()
            if found is not None:
                return stream, *found
        return None

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
            self._emit(stream, BuildingEye(target.eye, fraction, event.stage))
        elif isinstance(event, BuildDone):
            self._loads.append(
                StoreLoad(
                    *(self.engine, stream, target, event.ticket, event.built),
                    enough=self._frame_psfs[0],
                )
            )
        elif isinstance(event, BuildError):
            self._fail(stream, target, event.error)

    def _add_loaded(self, load: StoreLoad) -> None:
        """Add a loaded store to its stream, unless that has a newer profile."""
        stream, prepared = load.stream, load.prepared
        if stream.ticket != load.ticket:
            if prepared is not None:
                prepared.store.release()
            return
        stream.ticket = stream.building = None
        if prepared is None:
            assert load.error is not None
            self._fail(stream, load.target, _to_filter_error(load.error))
            return
        for part in load.late_parts:
            prepared.store.add_part(part)
        stream.add_store(load.target.eye, prepared)

    def _add_part(self, event: BuildPart) -> None:
        """Add a part from the worker to its store, if that still exists."""
        for load in self._loads:
            if load.ticket == event.ticket:
                load.late_parts.append(event.part)
        for prepared in self._prepared():
            if prepared.ticket == event.ticket:
                prepared.store.add_part(event.part)

    def _warm_first(
        self,
        stream: StreamEyes,
        eye: AcceptedProfile,
        prepared: PreparedStore,
    ) -> None:
        """Add PSFs of a first frame that were computed, or look for missing ones."""
        store = prepared.store
        try:
            if prepared.work is not None:
                prepared.work.add()
                self._report_progress(stream, eye, prepared, prepared.work)
                if not prepared.work.is_enough:
                    return
            # Pupil and focus may have changed meanwhile, so check again.
            psfs = first_psfs(
                *(store, prepared.camera, eye.settings, stream.history),
                is_first_check=not prepared.n_checks,
            )
            enough = self._frame_psfs[min(prepared.n_checks, 1)]
            grown = int(CHECK_LIMIT * CHECK_GROWTH ** (prepared.n_checks - 1))
            allowed = max(grown, enough) if prepared.n_checks else 0
            prepared.n_checks += 1
            prepared.work = None
            if psfs.size > allowed:
                prepared.work = PsfWork(store, psfs, enough=enough)
                return
        except Exception as error:  # must not affect other streams
            prepared.work = None
            target = BuildTarget(eye, prepared.camera)
            self._fail(stream, target, _to_filter_error(error))
            return
        self._set_ready(stream, eye, prepared)

    @property
    def _frame_psfs(self) -> tuple[int, ...]:
        """Return how many PSFs the first frame through a new eye may compute."""
        return tuple(int(share * self.frame_s / PSF_S) for share in FIRST_SHARES)

    def _report_progress(
        self,
        stream: StreamEyes,
        eye: AcceptedProfile,
        prepared: PreparedStore,
        work: PsfWork,
    ) -> None:
        now_s = time.monotonic()
        if now_s < prepared.next_progress_s:
            return
        prepared.next_progress_s = now_s + PROGRESS_INTERVAL_S
        n_computed = prepared.store.computed_count
        share = n_computed / max(n_computed + work.left.size, 1)
        fraction = EYE_PROGRESS + (1.0 - EYE_PROGRESS) * share
        self._emit(stream, BuildingEye(eye, fraction, "psfs"))

    def mark_rendered(
        self, stream: StreamEyes, eye: AcceptedProfile, store: FrameStore
    ) -> None:
        """Mark the store that a view was rendered with as ready."""
        for prepared in list(eye.stores):
            if not prepared.is_ready and prepared.store is store:
                self._set_ready(stream, eye, prepared)

    def _set_ready(
        self, stream: StreamEyes, eye: AcceptedProfile, prepared: PreparedStore
    ) -> None:
        # The event first: who finds the store ready also finds the event.
        self._emit(
            stream,
            EyeReady(
                eye,
                prepared.camera,
                build_ms=MS_PER_S * (time.monotonic() - prepared.started_s),
                psf_count=prepared.store.computed_count,
                memory_mb=prepared.store.memory_mb,
                notes=prepared.notes,
            ),
        )
        stream.set_ready(eye, prepared)

    def _warm_ahead(self, stream: StreamEyes) -> PsfWork | None:
        """Add PSFs of predicted states that were computed; return those to compute."""
        prepared = stream.store_in_use()
        if prepared is None:
            return None
        work = prepared.work
        try:
            if work is not None:
                work.add()
                work = work if work.left.size else None
            prepared.work = predicted_work(
                *(prepared.store, stream.history, prepared.predicted),
                partial(self.worker.plan_near, prepared.ticket),
                is_busy=self.frame_s > BUSY_SHARE * stream.history.interval_s,
                work=work,
            )
        except Exception as error:  # a frame that needs the PSFs reports it
            prepared.work = None
            log.info(
                "predicted PSFs could not be computed: %s", _to_filter_error(error)
            )
        return prepared.work

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
        self._cancel(stream)
        self._emit(stream, EyeFailed(target.eye, error))
        stream.fail_build(target.eye, target.camera, error)


def _to_filter_error(error: Exception) -> FilterError:
    """Return an error for clients; log an unexpected one."""
    if isinstance(error, FilterError):
        return error
    log.error("an eye could not be prepared", exc_info=error)
    return RenderFailed(f"{type(error).__name__}: {error}")
