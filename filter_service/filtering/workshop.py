"""Where eyes are made: one worker and one engine for all streams of a process.

Profiles of all streams go through the worker to the engine; what happens to them the
streams are told as events.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.building.jobs import BuildJob, BuiltStore
from filter_service.building.limits import BuildLimits
from filter_service.building.worker_handle import (
    BuildDone,
    BuildError,
    BuildEvent,
    BuildProgress,
    WorkerHandle,
)
from filter_service.camera import Camera
from filter_service.errors import BuildCancelled, FilterError, OutOfMemory, RenderFailed
from filter_service.filtering.accepted_profile import AcceptedProfile, PreparedStore
from filter_service.filtering.filtered import BuildingEye, EyeFailed, EyeReady
from filter_service.filtering.store_memory import held_mb, make_room
from filter_service.filtering.stream_eyes import StreamEyes, Wanted
from filter_service.filtering.upload import Upload
from filter_service.rendering.engine import FrameEngine, LoadedStore
from filter_service.settings import FilterSettings

MS_PER_S = 1e3

LOAD_RANGE_S = (0.004, 0.03)  # for copying a new store to the engine between two frames
LOAD_SHARE = 0.5  # of a frame's time: the stream is never late by a whole frame

log = logging.getLogger("ocufilter")


@dataclass(frozen=True, eq=False)
class _Loading:
    """A store that is built and not yet with the engine."""

    stream: StreamEyes
    wanted: Wanted
    built: BuiltStore
    upload: Upload


class Workshop:
    """Has the stores of profiles built and loaded, and tells their streams.

    Parameters
    ----------
    worker : WorkerHandle
        Started, or to be started by the first `advance`; `close` ends it.
    engine : FrameEngine
    limits : BuildLimits
    engine_name : str
        Of the engine, among those that may be chosen.
    """

    def __init__(
        self,
        worker: WorkerHandle,
        engine: FrameEngine,
        limits: BuildLimits,
        *,
        engine_name: str = "",
    ) -> None:
        self.worker = worker
        self.engine = engine
        self.engine_name = engine_name
        self.streams: list[StreamEyes] = []
        self.frame_s = 0.0  # what the last frame took to filter
        self._limits = limits
        self._loads: list[_Loading] = []
        self._released: list[Any] = []
        self._going: list[Any] = []

    @property
    def stores_mb(self) -> float:
        """Return what the stores of all streams take."""
        return held_mb(self.streams)

    @property
    def is_loading(self) -> bool:
        """Return whether `advance` has something to do at once."""
        return bool(self._loads)

    def accept(
        self,
        stream: StreamEyes,
        profile: EyeProfile,
        settings: FilterSettings,
        cameras: Sequence[Camera] = (),
        *,
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Take a profile in; a build of an older one that still runs is cancelled."""
        # Accepted in the same pass counts as well: its build has not begun, but its
        # sender awaits an ending too.
        building = stream.building
        begun = building is not None and not building.extends
        replaced = [building.eye] if building is not None and begun else []
        unfinished = stream.unfinished_eye()
        if unfinished is not None and unfinished not in replaced:
            replaced.append(unfinished)
        self.cancel(stream)
        for old in replaced:
            newer = "a newer profile" if profile_id is None else f"profile {profile_id}"
            error = BuildCancelled(
                f"{newer} took the place of profile {old.profile_id}"
            )
            stream.on_event(EyeFailed(old, error))
        eye = stream.add_profile(profile, settings, cameras, profile_id=profile_id)
        self.free_retired(stream)
        return eye

    def end(self, stream: StreamEyes) -> None:
        """Give up a stream with all its eyes."""
        if stream in self.streams:
            self.streams.remove(stream)
        self.cancel(stream)
        stream.end()
        self.free_retired(stream)

    def close(self) -> None:
        """End all streams and the worker."""
        for stream in list(self.streams):
            self.end(stream)
        self.worker.close()

    def cancel(self, stream: StreamEyes) -> None:
        """Stop what is being built and loaded for a stream."""
        if stream.ticket is not None:
            self.worker.cancel(stream.ticket)
        stream.ticket = stream.building = None
        for loading in self._loads_of(stream):
            self._loads.remove(loading)
            loading.upload.give_up()

    def free_retired(self, stream: StreamEyes) -> None:
        """Free the stores that a stream has given up."""
        for store in stream.retired:
            store.release()
        self._released += stream.retired
        stream.retired = []

    def _drop_released(self) -> None:
        """Let go of what was released, one turn later and in a thread.

        To return half a gigabyte to the system takes 0.2 s; by then the renderer has
        let go of it too.
        """
        dropped, self._going = self._going, self._released
        self._released = []
        if dropped:
            threading.Thread(target=dropped.clear, daemon=True).start()

    def advance(self) -> None:
        """Take in what the worker has to say; keep one build of each stream going.

        Built stores are copied to the engine in slices: half of a frame's time at once,
        within `LOAD_RANGE_S`, so that no frame is late by more.
        """
        self._drop_released()
        for event in self.worker.poll():
            stream = next((s for s in self.streams if s.ticket == event.ticket), None)
            # Without a stream, it has ended or wants something newer.
            if stream is not None:
                self._handle(stream, event)
        low_s, high_s = LOAD_RANGE_S
        load_s = min(max(LOAD_SHARE * self.frame_s, low_s), high_s)
        self._advance_loads(time.monotonic() + load_s)
        for stream in list(self.streams):
            if stream.builds_in_vain:
                self.cancel(stream)
            following = stream.next_build()
            if stream.building is None and following is not None:
                stream.building = following
                stream.ticket = self.worker.submit(self._job(stream, following))

    def _job(self, stream: StreamEyes, wanted: Wanted) -> BuildJob:
        return BuildJob(
            profile=wanted.eye.profile,
            settings=wanted.eye.settings,
            camera=wanted.camera,
            limits=self._limits,
            look_at=stream.look_at,
            ranges=wanted.ranges,
            with_preview=wanted.with_preview,
        )

    def _handle(self, stream: StreamEyes, event: BuildEvent) -> None:
        if stream.building is None:
            return  # its last word, after it was given up
        wanted = stream.building
        if isinstance(event, BuildProgress):
            if not wanted.extends:
                stage, eye = event.stage, wanted.eye
                stream.on_event(BuildingEye(eye, event.fraction, stage))
        elif isinstance(event, BuildDone):
            try:
                self._make_room(wanted, event.built.memory_mb)
            except OutOfMemory as error:
                self._give_up(stream, wanted, error)
                return
            if event.built.is_complete:
                stream.ticket = None
            upload = Upload(self.engine.load_steps(event.built.store))
            self._loads.append(_Loading(stream, wanted, event.built, upload))
        elif isinstance(event, BuildError):
            self._fail(stream, wanted, event.error)

    def _make_room(self, wanted: Wanted, size_mb: float) -> None:
        max_mb = self._limits.max_stores_mb
        try:
            make_room(
                self.streams,
                wanted,
                size_mb,
                max_mb=max_mb,
                now_s=time.monotonic(),
            )
        finally:
            for stream in self.streams:
                self.free_retired(stream)

    def _loads_of(self, stream: StreamEyes) -> list[_Loading]:
        return [loading for loading in self._loads if loading.stream is stream]

    def _advance_loads(self, deadline_s: float) -> None:
        """Go on with the oldest load: a stream's preview before the rest."""
        while self._loads:
            loading = self._loads[0]
            stream = loading.stream
            try:
                loaded = loading.upload.advance(deadline_s)
                if loaded is None:
                    return
            except Exception as error:
                if not isinstance(error, FilterError):
                    log.exception("a store could not be loaded")
                    error = RenderFailed(f"{type(error).__name__}: {error}")
                self._give_up(stream, loading.wanted, error)
            else:
                self._loads.pop(0)
                self._released.append(loading.built)
                self._put_in_place(loading, loaded)

    def _put_in_place(self, loading: _Loading, loaded: LoadedStore) -> None:
        stream, wanted, built = loading.stream, loading.wanted, loading.built
        if built.is_complete:
            stream.building = None
        stream.put_in_place(
            wanted.eye,
            PreparedStore(
                wanted.camera,
                loaded,
                built.is_complete,
                wanted.ranges if built.is_complete else built.ranges,
                built.build_ms / MS_PER_S,
                memory_mb=built.memory_mb,
            ),
        )
        self.free_retired(stream)
        if wanted.extends:
            return  # its sender knows that the eye is ready
        stream.on_event(
            EyeReady(
                wanted.eye,
                wanted.camera,
                build_ms=built.build_ms,
                psf_count=built.psf_count,
                memory_mb=built.memory_mb,
                notes=built.notes,
                is_complete=built.is_complete,
            )
        )

    def _give_up(self, stream: StreamEyes, wanted: Wanted, error: FilterError) -> None:
        """End the building of a store that the worker may still be busy with."""
        if stream.ticket is not None:
            self.worker.cancel(stream.ticket)
        self._fail(stream, wanted, error)

    def _fail(
        self,
        stream: StreamEyes,
        wanted: Wanted,
        error: FilterError,
    ) -> None:
        """End the building of a store, whether it failed there or at being loaded."""
        stream.ticket = None
        self.cancel(stream)
        if wanted.extends:
            log.warning("no more PSFs for a stream: %s", error)
            stream.fail_extension(wanted, error)
            return
        stream.fail_build(wanted.eye, wanted.camera, error)
        self.free_retired(stream)
        stream.on_event(EyeFailed(wanted.eye, error))
