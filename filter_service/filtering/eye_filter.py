"""`EyeFilter`: pictures through a person's eye, in this process, without a socket.

    camera = Camera.from_fov(50, width_px=480, height_px=270)
    with EyeFilter("keratoconus", camera) as eye_filter:
        seen = eye_filter.filter(color, depth_m, pupil_diameter_mm=4, focus_dpt=0)

The service holds one of these for each client.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Self

from numpy.typing import NDArray

from estimator.profiles.files import load_profile
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.camera import Camera
from filter_service.checked import checked
from filter_service.errors import BadMessage, NotPrepared, ServiceTimeout
from filter_service.filtering.accepted_profile import AcceptedProfile, PreparedStore
from filter_service.filtering.filtered import EyeEvent, EyeFailed, EyeReady, Filtered
from filter_service.filtering.planned_frame import PlannedFrame
from filter_service.filtering.shared_workshop import shared
from filter_service.filtering.stream_eyes import StreamEyes
from filter_service.filtering.workshop import Workshop
from filter_service.rgbd_view import ColorImage, RgbdView, as_views
from filter_service.settings import (
    DEFAULTS,
    Accumulation,
    Engine,
    FilterSettings,
    GazeDeg,
    Output,
    PupilMm,
    VergenceDpt,
    as_settings,
)

WAIT_SLICE_S = 0.02

Profile = EyeProfile | Mapping[str, Any] | str | Path


def as_profile(profile: Profile) -> EyeProfile:
    """Return a profile of any form: parsed, a map, a preset's name or a file.

    Raises
    ------
    ValueError
        Names the field, the bad value and what is allowed.
    """
    if isinstance(profile, Mapping):
        return parse_profile(profile)
    if isinstance(profile, str | Path):
        return load_profile(str(profile))
    return profile


def _as_cameras(cameras: Camera | Sequence[Camera]) -> tuple[Camera, ...]:
    found = (cameras,) if isinstance(cameras, Camera) else tuple(cameras)
    for camera in found:
        if not isinstance(camera, Camera):
            raise BadMessage(
                f"{camera!r}", field="camera", allowed="a Camera, or several"
            )
    return found


class EyeFilter:
    """One stream of frames through one person's eye, which may change on the way.

    Every frame shows the state that it asks for: PSFs that it lacks are computed before
    it is rendered, and kept.  A change of profile does not stop the stream: frames go
    through the old eye until a first frame through the new one would not wait.  All
    filters of a process share a worker and an engine unless told otherwise: one thread
    at a time may use them.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path, optional
        A parsed profile, its JSON object, a preset's name, or a file.
    camera : Camera, or several, optional
        What to prepare for; other cameras are prepared for when their frames come.
        Frames given as bare arrays are taken with the first.
    settings : FilterSettings or mapping, optional
    on_event : callable, optional
        Told of every `BuildingEye`, `EyeReady` and `EyeFailed`.
    workshop : Workshop, optional
        Where eyes are made; all filters of a process share one unless told otherwise.
    max_cameras : int
        Cameras that are kept prepared.
    first_generation : int
        Where profiles are counted from.
    engine : "auto", "gl" or "native"
        What filters frames where the workshop is shared: compute shaders, or compiled
        loops on all cores; "auto" takes gl on a hardware GPU, else native.

    Raises
    ------
    ValueError
        A profile that is wrong; names the field.
    RenderError
        No engine works on this machine; names what to install.
    """

    def __init__(
        self,
        profile: Profile | None = None,
        camera: Camera | Sequence[Camera] = (),
        settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
        *,
        on_event: Callable[[EyeEvent], None] | None = None,
        workshop: Workshop | None = None,
        max_cameras: int = 4,
        first_generation: int = 1,
        engine: Engine = "auto",
    ) -> None:
        first = None if profile is None else as_profile(profile)
        self.cameras = _as_cameras(camera)
        self.settings = as_settings(settings)
        self._on_event = on_event
        self._pid = os.getpid()
        self._shared = shared(engine) if workshop is None else None
        self._workshop: Workshop | None = workshop or shared(engine).take()
        self._eyes = StreamEyes(
            self._take_event,
            max_cameras,
            self.cameras,
            first_generation=first_generation,
        )
        self._workshop.streams.append(self._eyes)
        self._newest: AcceptedProfile | None = None
        self._failure: EyeFailed | None = None
        self.is_extending = False  # whether only PSFs of the last frame are missing
        self.ready: EyeReady | None = None
        if first is not None:
            try:
                self.set_profile(first, cameras=self.cameras)
            except BaseException:
                self.close()  # nobody else can: there is no filter to be closed
                raise

    def __enter__(self) -> Self:
        """Return the filter."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Give up what the filter holds."""
        self.close()

    def close(self) -> None:
        """Give up what the filter holds; closing twice is allowed."""
        if self._workshop is None or self._pid != os.getpid():
            return
        self._workshop.end(self._eyes)
        if self._shared is not None:
            self._shared.give_back()
        self._workshop = None

    @property
    def workshop(self) -> Workshop:
        """Return where the filter's eyes are made.

        Raises
        ------
        ValueError
            The filter is closed, or is that of the process which this one was forked
            from.
        """
        if self._workshop is None:
            raise ValueError("this EyeFilter is closed")
        if self._pid != os.getpid():
            raise ValueError(
                f"this EyeFilter was made in process {self._pid}, whose threads and "
                "worker it needs; expected one made in this process"
            )
        return self._workshop

    @property
    def prepared_stores(self) -> tuple[PreparedStore, ...]:
        """Return the stores of the newest eye, the one used last at the end."""
        return tuple(self._newest.stores) if self._newest is not None else ()

    # The eye

    def set_profile(
        self,
        profile: Profile,
        *,
        settings: FilterSettings | Mapping[str, Any] | None = None,
        cameras: Sequence[Camera] = (),
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Change the eye; frames go through the old one until it is ready.

        Parameters
        ----------
        settings : FilterSettings or mapping, optional
            Those of the filter where it is None.
        cameras : sequence of Camera, optional
            What to prepare for; else the cameras of the last frame, else those of the
            eye in use.
        profile_id : int, optional
            The caller's own number, which comes back with results; else the generation.

        Raises
        ------
        ValueError
            The profile is wrong, and the eye stays as it was.
        """
        self._newest = self.workshop.accept(
            self._eyes,
            as_profile(profile),
            self.settings if settings is None else as_settings(settings),
            _as_cameras(cameras),
            profile_id=profile_id,
        )
        return self._newest

    def keep_going(self) -> None:
        """Let new eyes be prepared where the workshop has no owner who does that."""
        if self._shared is not None:
            self.workshop.advance(ahead=False)

    def advance(self) -> None:
        """Let new eyes be prepared between frames, and compute PSFs ahead."""
        self.workshop.advance()

    def wait(self, timeout_s: float = 120.0) -> EyeReady:
        """Return when the newest eye is ready for all cameras it was asked for.

        Raises
        ------
        FilterError
            What the build of the eye ended with, or `ServiceTimeout`.
        BadMessage
            There is no profile, or no camera that it could be prepared for.
        """
        deadline_s = time.monotonic() + timeout_s
        if self._newest is None:
            raise BadMessage("there is no profile", field="profile")
        while True:
            self.workshop.advance()
            failure, self._failure = self._failure, None
            if failure is not None and failure.eye is self._newest:
                raise failure.error
            if not self._newest.wanted:
                return self._ending(self._newest)
            self._wait_for_worker(deadline_s, "the eye to be ready")

    def _ending(self, eye: AcceptedProfile) -> EyeReady:
        """Return what came of an eye for which nothing more is built."""
        if self.ready is not None and self.ready.eye is eye and self.ready.is_complete:
            return self.ready
        if eye.failures:  # told before: nothing has changed since
            raise eye.failures[-1][1].with_traceback(None)
        raise BadMessage(
            "it is not known", field="camera", allowed="a camera to prepare for"
        )

    def _take_event(self, event: EyeEvent) -> None:
        if isinstance(event, EyeFailed):
            self._failure = event
        elif isinstance(event, EyeReady):
            self.ready = event
        if self._on_event is not None:
            self._on_event(event)

    def _wait_for_worker(self, deadline_s: float, what: str) -> None:
        remaining_s = deadline_s - time.monotonic()
        if remaining_s <= 0.0:
            raise ServiceTimeout(f"waited in vain for {what}")
        descriptor = self.workshop.worker.file_descriptor
        watched = [] if descriptor is None else [descriptor]
        if not self.workshop.is_warming:
            wait(watched, min(remaining_s, WAIT_SLICE_S))  # select ends at 1024

    # Frames

    def filter(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView],
        depth_m: NDArray[Any] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        accumulation: Accumulation = "coverage",
        merge: bool = True,
        render_tolerance: float = 1.0,
        whole: bool = False,
        timeout_s: float = 120.0,
    ) -> Filtered:
        """Filter one frame; computes the PSFs that it lacks.

        Parameters
        ----------
        color : (height, width, 3) array, RgbdView, or several views
            uint8 sRGB, or float32 or float16 linear light.
        depth_m : (height, width) float32
            View-space z in metres, beside an array of colour; else part of the view.
        pupil_diameter_mm : float, 0.5 to 9
            Entrance pupil.
        focus_dpt : float, 0 to 20
            Where the person wants to focus; 0 is infinity.
        gaze_deg : (h, v), optional
            Where the eye looks in the image; as in the settings where it is None.
        output : "srgb8", "linear" or "linear16"
            8-bit sRGB, or linear light in float32 or float16.
        accumulation : "coverage" or "paper"
            How light of several distances is put together: nearer surfaces hide what
            they cover, or the published sum.
        merge : bool
            Let near-equal pixels share a splat; off is slower.
        render_tolerance : float, 0 to 8
            Errors of rendering against the usual, which leaves no visible difference;
            0 is exact, more is faster.
        whole : bool
            Wait for the newest eye, as a single picture may: a stream would rather see
            the eye before until then.
        timeout_s : float
            For the eye to be estimated and for its PSFs.

        Returns
        -------
        Filtered

        Raises
        ------
        BadMessage
            An argument out of range (a ValueError, too).
        SessionError
            There is no profile, or its build failed.
        RenderError
            The engine failed.
        ServiceTimeout
        """
        views = as_views(color, depth_m, next(iter(self.cameras), None))
        deadline_s = time.monotonic() + timeout_s
        while True:
            seen = self.try_filter(
                views,
                pupil_diameter_mm=pupil_diameter_mm,
                focus_dpt=focus_dpt,
                gaze_deg=gaze_deg,
                output=output,
                accumulation=accumulation,
                merge=merge,
                render_tolerance=render_tolerance,
                newest_only=whole,
                until_s=deadline_s,
            )
            self.workshop.advance(ahead=False)  # it knows what this frame asks for
            if seen is not None:
                return seen
            self._wait_for_worker(deadline_s, "the eye to be prepared for this camera")

    def try_filter(
        self,
        views: Sequence[RgbdView],
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        accumulation: Accumulation = "coverage",
        merge: bool = True,
        render_tolerance: float = 1.0,
        newest_only: bool = False,
        until_s: float | None = None,
        out: Sequence[NDArray[Any] | None] | None = None,
    ) -> Filtered | None:
        """Filter one frame like `filter`; None while its eye is being prepared.

        Parameters
        ----------
        newest_only : bool
            None, and `is_extending`, while there is an older eye to show.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed: None, and
            `is_extending`, where some are left.  Those that were computed are kept, so
            that the next frame goes on from there.
        out : sequence of arrays, optional
            Memory for the pictures, which may be used; what is returned counts.

        Raises
        ------
        BadMessage
            An argument out of range (a ValueError, too).
        SessionError
            There is no profile, or its build failed.
        RenderError
            The engine failed.
        """
        self.keep_going()
        if gaze_deg is not None:
            gaze_deg = checked(gaze_deg, tuple[GazeDeg, GazeDeg], "gaze_deg")
        planned = self.plan(
            views,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            gaze_deg=gaze_deg,
            newest_only=newest_only,
        )
        if planned is None:
            return None
        try:
            return planned.render(
                gazes_deg=[gaze_deg] * len(views),
                output=output,
                accumulation=accumulation,
                merge=merge,
                render_tolerance=render_tolerance,
                out=out,
                until_s=until_s,
            )
        except NotPrepared:
            self.is_extending = True
            return None

    def plan(
        self,
        views: Sequence[RgbdView],
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        newest_only: bool = False,
    ) -> PlannedFrame | None:
        """Return a frame ready to be rendered, before anything else is asked for.

        None, and what it raises: as of `try_filter`.  The frames of a person's two eyes
        are both planned before one is rendered, so that both are being prepared; what
        `keep_going` puts in place may free what was planned with.
        """
        pupil_diameter_mm = checked(pupil_diameter_mm, PupilMm, "pupil_diameter_mm")
        focus_dpt = checked(focus_dpt, VergenceDpt, "focus_dpt")
        self._eyes.use.note(
            views,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            gaze_deg=gaze_deg,
            at_s=time.monotonic(),
        )
        workshop = self.workshop
        plan = self._eyes.plan([view.camera for view in views])
        workshop.free_retired(self._eyes)
        self.is_extending = (
            plan is not None and newest_only and not self._eyes.is_newest(plan)
        )
        if plan is None or self.is_extending:
            return None
        return PlannedFrame(
            workshop, self._eyes, plan, tuple(views), pupil_diameter_mm, focus_dpt
        )
