"""Builder: prepares the eyes of all streams of a process.

The build worker estimates the eye of a profile, the engine loads it, and a thread
computes the PSFs of a first frame in small batches between frames.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from multiprocessing.connection import wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from filter_service.filtering.priority_lock import PriorityLock, Signal
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
from filter_service.rendering.frame_kernels import first_frame
from filter_service.rendering.frame_states import FrameStore
from filter_service.settings import FilterSettings
from filter_service.view_state import State

MS_PER_S = 1e3

EYE_PROGRESS = 0.3
"""Progress at which the eye is estimated and the nodes of its PSFs are known."""

EVICTION_SHARE = 0.8
"""Eviction reduces an eye's PSFs to this share of its limit, so that it is rare."""

FIRST_RANGE_S, FIRST_SHARE = (0.004, 0.08), 1.0
"""Time that a frame leaves to the first PSFs of a new eye before the next one: this
share of its duration, within the range.  During a stream of 1280x720 that takes both
cores, with a worker of niceness 0, new eyes appeared after 0.7 to 1.5 s; with half of
the time, and at most 0.03 s, after 1.1 to 2.5 s."""

WARM_BATCH = 256
"""PSFs per batch, 5 ms on two cores: so long a frame waits for the preparation."""

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

TRIM_AFTER_S = 0.5
"""Delay after which freed memory is returned to the system, which takes 1 to 10 ms."""

IDLE_WAIT_S, RESTART_WAIT_S = 0.5, 0.1
"""Longest waits for the worker's next message, and while it is not running."""

log = logging.getLogger("ocufilter")


class Builder:
    """Builds eyes in the build worker, and computes PSFs before frames need them.

    A thread does both, from the first profile on.  It and the calls of the builder's
    methods exclude each other; a call waits for one batch of PSFs at most.  The thread
    uses no OpenGL, and no events are delivered in it.

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

    # Frames

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Exclude preparation while a frame is begun, after the time that it gets."""
        self._lock.wait_for_reserved(FIRST_RANGE_S[1])
        with self.exclusive():
            yield

    def exclusive(self) -> AbstractContextManager[None]:
        """Exclude preparation during a call, which goes first."""
        return self._lock.foreground()

    def end_frame(self, stream: StreamEyes, duration_s: float) -> None:
        """Note that a frame was rendered, and deliver the events of its stream."""
        self.frame_s = duration_s
        # A frame that interrupts another cannot wait.
        if (
            self._thread
            and not self._lock.has_foreground
            and self._to_warm() is not None
        ):
            low_s, high_s = FIRST_RANGE_S
            self._lock.reserve(min(max(FIRST_SHARE * duration_s, low_s), high_s))
        if self.wakes_after_frames:
            self._wake.set()
        self.deliver(stream)

    def let_thread_work(self) -> None:
        """Let the thread work during a frame that pauses, if it has anything to do."""
        self._lock.pause(FIRST_RANGE_S[1])

    def trim(self) -> None:
        """Release buffers of the engine after an idle period."""
        with self.exclusive():
            self.engine.trim()

    # Events

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
        if not self.worker.has_process and self._step():
            timeout_s = 0.0
        self.deliver(stream, timeout_s)

    # Streams

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

    # The thread

    def _run(self) -> None:
        """Prepare eyes until the builder is closed."""
        while not self._is_closed:
            with self._lock.background() as may_work:
                if not may_work:
                    continue
                try:
                    has_more = self._step()
                except Exception:  # must not end the preparation of other eyes
                    log.exception("eyes could not be prepared")
                    has_more = False
                if self._to_warm() is None:
                    self._lock.reserve(0.0)
                if not has_more:
                    self._lock.resume()
            if self._drop_released() or has_more:
                continue
            self._trim_heap()
            worker = self.worker.file_descriptor
            watched: list[Any] = (
                [self._wake] if worker is None else [self._wake, worker]
            )
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

    def _step(self) -> bool:
        """Process the worker's events, then compute a batch of PSFs.

        Returns whether more PSFs can be computed now.
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
        found = self._to_warm()
        if found is not None:
            self._warm_first(*found)
            _, _, prepared = found
            n_computed = prepared.store.computed_count
            # Not those that were evicted and are computed again, without end.
            if n_computed > prepared.n_most_computed:
                prepared.n_most_computed = n_computed
                self.n_advances += 1
        has_more = found is not None or any(map(self._warm_ahead, self.streams))
        self._limit_memory()
        return has_more

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
        elif isinstance(event, BuildError):
            self._fail(stream, target, event.error)

    def _add_part(self, event: BuildPart) -> None:
        """Add a part from the worker to its store, if that still exists."""
        for prepared in self._prepared():
            if prepared.ticket == event.ticket:
                prepared.store.add_part(event.part)

    # PSFs that are computed before frames need them

    def _warm_first(
        self,
        stream: StreamEyes,
        eye: AcceptedProfile,
        prepared: PreparedStore,
    ) -> None:
        """Compute a batch of the PSFs of a first frame."""
        store, use = prepared.store, stream.history.last
        is_all = eye.settings.prepare == "ranges"
        try:
            if not prepared.pending.size:
                use = use or first_frame(prepared.camera, eye.settings)
                prepared.pending = store.missing_psfs(None if is_all else use)
                prepared.n_missing = prepared.pending.size
            if prepared.n_missing:
                self._report_progress(stream, eye, prepared)
                prepared.pending = _without_batch(store, prepared.pending)
                if prepared.pending.size:
                    return
                # Pupil and focus may have changed meanwhile, so check again.
                prepared.n_checks += 1
                if prepared.n_missing > WARM_BATCH * CHECK_GROWTH ** (
                    prepared.n_checks - 1
                ):
                    return
        except Exception as error:  # must not affect other streams
            target = BuildTarget(eye, prepared.camera)
            self._fail(stream, target, _to_filter_error(error))
            return
        self._set_ready(stream, eye, prepared)

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

    def _warm_ahead(self, stream: StreamEyes) -> bool:
        """Compute PSFs of a stream's predicted states; return whether some are left."""
        prepared, last = stream.store_in_use(), stream.history.last
        if prepared is None or last is None or last is stream.history.last_warmed:
            return False
        if self.frame_s > BUSY_SHARE * stream.history.interval_s:
            return False
        store = prepared.store
        try:
            for state in stream.history.predicted_states():
                left = store.missing_psfs(last, state=state)
                while left.size:
                    left = _without_batch(store, left)
                    if self._lock.has_foreground:  # their frame may need other PSFs
                        return True
        except Exception as error:  # a frame that needs the PSFs reports it
            log.info(
                "predicted PSFs could not be computed: %s", _to_filter_error(error)
            )
        stream.history.last_warmed = last
        return False

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


def _without_batch(store: FrameStore, psfs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Compute a batch of PSFs (n,); return the others."""
    left = store.fill(psfs[:WARM_BATCH], until_s=0.0, batch_count=WARM_BATCH)
    return np.concatenate([left, psfs[WARM_BATCH:]])


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
