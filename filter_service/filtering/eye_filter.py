"""`EyeFilter`: filters frames through one eye, in this process.

    camera = Camera.from_fov(50, width_px=480, height_px=270)
    with EyeFilter("keratoconus", camera) as eye_filter:
        seen = eye_filter.filter(color, depth_m, pupil_diameter_mm=4, focus_dpt=0)

The service uses one filter for each eye of a session.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NoReturn, Self, Unpack

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.errors import BadMessage, RenderFailed, ServiceTimeout
from filter_service.filter_protocol import Filter
from filter_service.filtering.builder import Builder
from filter_service.filtering.operator import (
    FilterOperator,
    operator_options,
    views_of_depth,
)
from filter_service.filtering.planned_frame import Filtered, PlannedFrame, PlannedView
from filter_service.filtering.shared_builder import SharedBuilder, acquired
from filter_service.filtering.stream_eyes import (
    AcceptedProfile,
    BuildingEye,
    EyeEvent,
    EyeFailed,
    EyeReady,
    PreparedStore,
    Preparing,
    StreamEyes,
)
from filter_service.given_profile import Profile, as_profile
from filter_service.rgbd_view import ColorImage, RgbdView, as_cameras, as_views
from filter_service.settings import (
    DEFAULTS,
    Engine,
    FilterSettings,
    Output,
    RenderOptions,
    RenderOptionValues,
    as_settings,
)
from filter_service.stage_times import StageTimes
from filter_service.texture_view import GlTexture, TextureView
from filter_service.view_state import EyeName, State
from filter_service.waiting import Wait

WAIT_SLICE_S = 0.02


class EyeFilter:
    """Filters a stream of frames through one eye, which may change during the stream.

    Every frame shows the requested pupil and focus: missing PSFs are computed before it
    is rendered, and cached.  A new profile does not interrupt the stream: frames use
    the previous eye until the PSFs of a first frame through the new one are computed.
    By default all filters of a process share a build worker and an engine, which only
    one thread at a time may use.

    If it takes more than 2 s to open the filter, to `wait` or to `filter`, a bar on
    stderr shows the progress.  There is none without a terminal, with ``on_event``,
    while the program shows a `Progress`, or if the environment variable
    ``OCUFILTER_PROGRESS`` is 0.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path, optional
        A parsed profile, its JSON object, a preset's name, or a file.
    camera : Camera or sequence of Camera, optional
        Cameras to prepare for; others are prepared for when their frames arrive.
        Frames given as arrays use the first one.
    settings : FilterSettings or mapping, optional
    on_event : callable, optional
        Called with each `BuildingEye`, `EyeReady` and `EyeFailed` event, during calls
        of the filter.
    builder : Builder, optional
        Builder with its engine; by default shared by all filters of the process.
    max_cameras : int
        Number of cameras for which the eye stays prepared.
    first_generation : int
        Generation of the first profile.
    engine : "auto", "gl" or "native"
        Engine of the shared builder: compute shaders, or compiled loops on all cores;
        "auto" selects gl on a hardware GPU, otherwise native.
    gl_context : "own" or "current"
        OpenGL context of the engine gl: one of its own, or the one that is current now,
        as `filter_textures` requires.  The latter must be current for every call.
    worker : bool, optional
        Whether a process of its own estimates eyes; by default except in a daemonic
        process, such as a worker of a PyTorch `DataLoader`.  Without one, calls that
        wait for an eye estimate it: less processor time if each eye has few images.

    Raises
    ------
    ValueError
        If the profile is invalid; the message names the field.
    RenderError
        If no engine works on this machine.
    """

    def __init__(
        self,
        profile: Profile | None = None,
        camera: Camera | Sequence[Camera] = (),
        settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
        *,
        on_event: Callable[[EyeEvent], None] | None = None,
        builder: Builder | None = None,
        max_cameras: int = 4,
        first_generation: int = 1,
        engine: Engine = "auto",
        gl_context: Literal["own", "current"] = "own",
        worker: bool | None = None,
    ) -> None:
        first = None if profile is None else as_profile(profile)
        self.cameras = as_cameras(camera)
        self.settings = as_settings(settings)
        self._on_event = on_event
        self._pid = os.getpid()
        self._shared: SharedBuilder | None = None
        self._takes_textures = builder is not None or gl_context == "current"
        if builder is None:
            with self._new_wait("Opening the filter"):
                builder, self._shared = acquired(engine, gl_context, worker=worker)
        self._builder: Builder | None = builder
        self._eyes = StreamEyes(
            self._handle_event,
            max_cameras,
            self.cameras,
            first_generation=first_generation,
        )
        self._builder.streams.append(self._eyes)
        self._newest: AcceptedProfile | None = None
        self._failure: EyeFailed | None = None
        self._progress: tuple[float | None, str] = None, ""
        self.ready: EyeReady | None = None
        if first is not None:
            try:
                self.set_profile(first, views=self.cameras)
            except BaseException:
                self.close()  # the caller gets no filter that it could close
                raise

    def __enter__(self) -> Self:
        """Return the filter."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Release the filter's resources."""
        self.close()

    def __reduce__(self) -> NoReturn:
        """Raise a TypeError."""
        raise TypeError("an EyeFilter cannot be pickled; open one in each process")

    def close(self) -> None:
        """Release the filter's resources; further calls do nothing."""
        if self._builder is None or self._pid != os.getpid():
            return
        self._builder.end(self._eyes)
        if self._shared is not None:
            self._shared.release()
        self._builder = None

    @property
    def builder(self) -> Builder:
        """Return the filter's builder and engine.

        Raises
        ------
        ValueError
            If the filter is closed, or was created before this process was forked.
        """
        if self._builder is None:
            raise ValueError("this EyeFilter is closed")
        if self._pid != os.getpid():
            raise ValueError(
                f"this EyeFilter belongs to process {self._pid}; create one in this "
                "process"
            )
        return self._builder

    @property
    def prepared_stores(self) -> tuple[PreparedStore, ...]:
        """Return the stores of the newest eye, in order of last use."""
        return tuple(self._newest.stores) if self._newest is not None else ()

    # The eye

    def set_profile(
        self,
        profile: Profile,
        *,
        settings: FilterSettings | Mapping[str, Any] | None = None,
        views: Camera | RgbdView | Sequence[Camera | RgbdView] = (),
        profile_id: int | None = None,
    ) -> AcceptedProfile:
        """Change the eye; frames use the previous one until the new one is ready.

        Parameters
        ----------
        profile : EyeProfile, mapping, str or Path
        settings : FilterSettings or mapping, optional
            Settings of the eye; by default the settings of the filter.
        views : camera or view, or several, optional
            Cameras to prepare for; by default the cameras of the last frame, otherwise
            the cameras of the eye in use.
        profile_id : int, optional
            Identifier that results return; by default the generation.

        Returns
        -------
        AcceptedProfile

        Raises
        ------
        ValueError
            If the profile is invalid; the eye is then unchanged.
        """
        self._newest = self.builder.accept(
            self._eyes,
            as_profile(profile),
            self.settings if settings is None else as_settings(settings),
            as_cameras(views),
            profile_id=profile_id,
        )
        return self._newest

    def wait(self, timeout_s: float = 120.0) -> EyeReady:
        """Wait until the newest eye is ready for all requested cameras.

        Parameters
        ----------
        timeout_s : float
            As for `filter`.

        Raises
        ------
        FilterError
            If the eye's build failed.
        ServiceTimeout
        BadMessage
            If there is no profile, or no camera to prepare for.
        """
        if self._newest is None:
            raise BadMessage("there is no profile", field="profile")
        with self._new_wait("Preparing the eye", timeout_s) as waiting:
            while True:
                is_over = not self._newest.requested  # before its events are read
                self.builder.deliver(self._eyes)
                failure, self._failure = self._failure, None
                if failure is not None and failure.eye is self._newest:
                    raise failure.error
                if is_over:
                    return self._outcome(self._newest)
                self._wait_for_worker(waiting, "the eye to be ready")

    def _outcome(self, eye: AcceptedProfile) -> EyeReady:
        """Return or raise the outcome of an eye whose builds have finished."""
        if self.ready is not None and self.ready.eye is eye:
            return self.ready
        if eye.failures:  # reported before
            raise eye.failures[-1][1].with_traceback(None)
        raise BadMessage(
            "it is missing", field="camera", allowed="a camera to prepare for"
        )

    def _handle_event(self, event: EyeEvent) -> None:
        if isinstance(event, EyeFailed):
            self._failure = event
        elif isinstance(event, EyeReady):
            self.ready = event
            self._progress = 1.0, "frame"
        elif isinstance(event, BuildingEye):
            self._progress = event.fraction, event.stage
        if self._on_event is not None:
            self._on_event(event)

    def _new_wait(self, title: str, timeout_s: float = math.inf) -> Wait:
        self._progress = None, ""
        return Wait(title, timeout_s, is_shown=self._on_event is None)

    def _wait_for_worker(self, waiting: Wait, what: str) -> None:
        waiting.update(self.builder.n_advances, *self._progress)
        remaining_s = waiting.remaining_s
        if remaining_s <= 0.0:
            raise ServiceTimeout(f"timed out while waiting for {what}")
        self.builder.await_event(self._eyes, min(remaining_s, WAIT_SLICE_S))

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
        whole: bool = False,
        timeout_s: float = 120.0,
        **options: Unpack[RenderOptionValues],
    ) -> Filtered:
        """Filter one frame; compute missing PSFs first.

        Parameters
        ----------
        color : (height, width, 3) array, RgbdView, or sequence of RgbdView
            uint8 sRGB, or float32 or float16 linear light.
        depth_m : (height, width) float32
            View-space z in meters, if ``color`` is an array.
        pupil_diameter_mm : float, 0.5 to 9
            Diameter of the entrance pupil.
        focus_dpt : float, 0 to 20
            Distance of intended focus; 0 is infinity.
        gaze_deg : (h, v), optional
            Gaze in the image; by default from the settings.
        output : "srgb8", "linear" or "linear16"
            8-bit sRGB, or linear light in float32 or float16.
        whole : bool
            Whether to wait until the newest eye is ready, instead of using the previous
            one meanwhile.
        timeout_s : float
            Longest time in which neither the build of an eye nor the computation of its
            PSFs advances.
        **options
            Fields of `RenderOptions`, such as ``render_tolerance=0``, which is exact.

        Returns
        -------
        Filtered

        Raises
        ------
        BadMessage
            If an argument is out of range (a ValueError, too).
        SessionError
            If there is no profile, or its build failed.
        RenderError
            If the engine failed.
        ServiceTimeout
        """
        views = as_views(color, depth_m, next(iter(self.cameras), None))
        with self._new_wait("Filtering", timeout_s) as waiting:
            while True:
                seen = self.try_filter(  # without a limit: its PSFs advance
                    views,
                    pupil_diameter_mm=pupil_diameter_mm,
                    focus_dpt=focus_dpt,
                    gaze_deg=gaze_deg,
                    output=output,
                    newest_only=whole,
                    **options,
                )
                if seen:
                    return seen
                self._wait_for_worker(waiting, "the eye to be prepared for this camera")

    def operator(
        self,
        depth_m: NDArray[Any] | RgbdView | Sequence[RgbdView],
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        render_tolerance: float = 1.0,
        timeout_s: float = 120.0,
    ) -> FilterOperator:
        """Return the filter of one frame as a linear operator; compute its PSFs first.

        It computes what `filter` computes with ``merge=False, bright_pixels=False,
        output="linear"``, and the adjoint.  It uses the native engine, whatever the
        filter's engine is.

        Parameters
        ----------
        depth_m : (height, width) float32, RgbdView, or sequence of RgbdView
            Depth as for `filter`, or views, whose colors are ignored.
        pupil_diameter_mm, focus_dpt, gaze_deg, render_tolerance, timeout_s
            As for `filter`.

        Raises
        ------
        BadMessage
            In addition to the errors of `filter`: the pipeline is "published", or views
            have different shapes.
        """
        views = views_of_depth(depth_m, next(iter(self.cameras), None))
        states = [State.checked(pupil_diameter_mm, focus_dpt, gaze_deg)] * len(views)
        options = operator_options(render_tolerance)
        is_sequence = not isinstance(depth_m, RgbdView | np.ndarray)
        with self._new_wait("Preparing the operator", timeout_s) as waiting:
            while not (planned := self.plan(views, states, newest_only=True)):
                self._wait_for_worker(waiting, "the eye to be prepared for this camera")
        return FilterOperator.of(planned, options, is_sequence=is_sequence)

    def try_filter(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView],
        depth_m: NDArray[Any] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        newest_only: bool = False,
        until_s: float | None = None,
        out: Sequence[NDArray[Any] | None] | None = None,
        **options: Unpack[RenderOptionValues],
    ) -> Filtered | Preparing:
        """Filter one frame like `filter`, but do not wait until its eye is prepared.

        Parameters
        ----------
        newest_only : bool
            Whether to return `Preparing` while only an older eye is ready.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed.  If some are
            missing then, this returns `Preparing`; the computed ones stay cached for
            the next frame.
        out : sequence of arrays, optional
            Output arrays that may be used; only the returned arrays are valid.

        Returns
        -------
        Filtered or Preparing
            The latter is false: ``while not (seen := eye_filter.try_filter(...))``.

        Raises
        ------
        BadMessage
            If an argument is out of range (a ValueError, too).
        SessionError
            If there is no profile, or its build failed.
        RenderError
            If the engine failed.
        """
        finish = self.begin(
            color,
            depth_m,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            gaze_deg=gaze_deg,
            output=output,
            newest_only=newest_only,
            until_s=until_s,
            out=out,
            **options,
        )
        return finish() if finish else finish

    def begin(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView],
        depth_m: NDArray[Any] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        newest_only: bool = False,
        until_s: float | None = None,
        out: Sequence[NDArray[Any] | None] | None = None,
        **options: Unpack[RenderOptionValues],
    ) -> Callable[[], Filtered | Preparing] | Preparing:
        """Start one frame; return a function that waits for it and returns the result.

        On a hardware GPU, the CPU is free until then: to render, to begin the frame of
        the other eye, or to begin the next frame, whose images are copied while the GPU
        filters this one.  Other engines filter the frame at once.  The parameters and
        errors are the same as for `try_filter`, which waits.

        Returns
        -------
        callable or Preparing
            The latter, which is false, while the eye is being prepared.  The function
            also returns one if PSFs were not computed by ``until_s``.
        """
        views = as_views(color, depth_m, next(iter(self.cameras), None))
        state = State.checked(pupil_diameter_mm, focus_dpt, gaze_deg)
        planned = self.plan(views, [state] * len(views), newest_only=newest_only)
        if isinstance(planned, Preparing):
            return planned
        return planned.begin(
            output=output,
            options=RenderOptions(**options),
            out=out,
            until_s=until_s,
            times=StageTimes(),
        )

    def filter_textures(
        self,
        view: TextureView,
        target: GlTexture,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        target_is_top_first: bool | None = None,
        newest_only: bool = False,
        **options: Unpack[RenderOptionValues],
    ) -> Filtered | Preparing:
        """Filter a frame from textures to a texture, all in the caller's context.

        This submits the frame to the GPU and does not wait for it, except for the first
        frame of an eye.  Later commands of the context see the filtered image.  Counts,
        and samples of the input, belong to an earlier frame.  The caller's OpenGL
        state is kept.  While the eye is prepared, this writes nothing and returns
        `Preparing`, which is false.

        A frame that needs PSFs that are not computed yet uses others instead; the
        next frames have them.  The setting ``prepare="ranges"`` prepares all of them.

        Parameters
        ----------
        view : TextureView
        target : GlTexture
            Texture of the size of the view: "rgba8" or "srgb8_a8" receives sRGB values,
            "rgba16f" linear light.  Alpha is copied from the input.
        pupil_diameter_mm, focus_dpt, gaze_deg, options
            As for `filter`.
        target_is_top_first : bool, optional
            Whether the first row of the target is the top of the image; by default as
            in the view.
        newest_only : bool
            As for `try_filter`.

        Raises
        ------
        BadMessage
            If an argument is out of range, textures do not fit, or the profile has
            straylight or spectacle magnification, which only frames of arrays have.
        SessionError
            If there is no profile, or its build failed.
        RenderError
            If the filter does not use the caller's context (``gl_context``), another
            context is current, or OpenGL cannot draw to the target.
        """
        if not self._takes_textures:
            raise RenderFailed(
                "frames in textures need EyeFilter(..., gl_context='current')"
            )
        state = State.checked(pupil_diameter_mm, focus_dpt, gaze_deg)
        planned = self.plan([view], [state], newest_only=newest_only)
        if isinstance(planned, Preparing):
            return planned
        found = planned.begin(
            options=RenderOptions(**options),
            out=[target],
            target_is_top_first=target_is_top_first,
            times=StageTimes(),
        )()
        assert isinstance(found, Filtered)  # as the frame does not wait
        return found

    def plan(
        self,
        views: Sequence[RgbdView | TextureView],
        states: Sequence[State],
        *,
        name: EyeName = "both",
        newest_only: bool = False,
    ) -> PlannedFrame | Preparing:
        """Return a frame that is ready to be rendered, or `Preparing`.

        All states have the same pupil and focus.  Errors are those of `try_filter`.
        To prepare two eyes at the same time, plan the frames of both before you render
        one.  Render a plan before the next call, which may free the plan's stores.
        """
        arrays = [view for view in views if isinstance(view, RgbdView)]
        if arrays:
            with self.builder.exclusive():
                self._eyes.history.record(arrays, states[0], at_s=time.monotonic())
        cameras = [view.camera for view in views]
        found = self.builder.plan(self._eyes, cameras, newest_only=newest_only)
        if isinstance(found, Preparing):
            return found
        eye, stores = found
        return PlannedFrame(
            tuple(
                PlannedView(self.builder, self._eyes, eye, store, view, state, name)
                for store, view, state in zip(stores, views, states, strict=True)
            )
        )


if TYPE_CHECKING:  # mypy checks here that the class implements the protocol
    _: type[Filter] = EyeFilter
