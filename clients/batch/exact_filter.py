"""Filter whose images do not depend on previous frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clients.batch.job import Job
from filter_service import Camera, EyeFilter, Filtered, FilterError, RgbdView
from filter_service.errors import WorkerCrashed

ATTEMPTS = 2


class EngineUnusable(RuntimeError):
    """The engine does not work on this machine; the message says what to install."""


class ExactFilter:
    """Filter of a job's frames, which keeps one eye and camera at a time.

    PSFs are prepared for exactly the camera of the frame.  With a cache that accepts
    similar cameras, images would depend on which camera came first.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._key: tuple[str, Camera] | None = None
        self._open: EyeFilter | None = None  # keeps the engine and the builder alive
        self._filter: EyeFilter | None = None
        self._failure: FilterError | None = None
        self.build_s = 0.0

    def close(self) -> None:
        """Release the eye, the engine and the builder."""
        self._release_eye()
        if self._open is not None:
            self._open.close()
        self._open = None

    def _release_eye(self) -> None:
        if self._filter is not None:
            self._filter.close()
        self._filter = self._key = self._failure = None

    def see(
        self, profile: str, view: RgbdView, *, pupil_mm: float, focus_dpt: float
    ) -> Filtered:
        """Filter a frame through a profile.

        Raises
        ------
        FilterError
            If the eye cannot be prepared for this camera, or the frame cannot be
            filtered.
        """
        if self._key != (profile, view.camera):
            self._prepare(profile, view.camera)
        if self._failure is not None or self._filter is None:
            raise self._failure or RuntimeError("the filter is closed")
        return self._filter.filter(
            view,
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            output=self._job.output,
            render_tolerance=self._job.render_tolerance,
        )

    def _prepare(self, profile: str, camera: Camera) -> None:
        try:
            self._open = self._open or EyeFilter(engine=self._job.engine)
        except FilterError as error:
            raise EngineUnusable(str(error)) from None
        for _ in range(ATTEMPTS):
            self._release_eye()
            self._key = profile, camera
            body: Mapping[str, Any] = self._job.profiles[profile]
            settings, engine = self._job.settings, self._job.engine
            self._filter = EyeFilter(body, camera, settings, engine=engine)
            try:
                ready = self._filter.wait()
                self.build_s += ready.build_ms / 1e3
                return
            except WorkerCrashed as error:  # possibly for lack of memory
                self._failure = error
            except FilterError as error:
                self._failure = error
                return
