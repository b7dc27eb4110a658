"""Filters of both eyes' frames, in this process or in a service."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame
from clients.headset.runtime import EYES, DueFrame, Eye, EyeView, Image
from clients.headset.stereo_gaze import (
    EyeAndGaze,
    Picture,
    RgbdPicture,
    TexturePicture,
)
from filter_service import (
    BuildingEye,
    EyeFailed,
    EyeFilter,
    EyeReady,
    Filtered,
    FilterSettings,
    GlTexture,
    RgbdView,
    TextureView,
    plan_views,
)
from filter_service.errors import BadMessage, BuildCancelled, FilterError
from filter_service.messages import (
    Camera,
    Dropped,
    ErrorReply,
    EyeName,
    Ready,
    ViewState,
    body_of_eye,
)
from filter_service.settings import Output

if TYPE_CHECKING:
    import moderngl

EyeEvent = BuildingEye | EyeFailed | EyeReady
Say = Callable[[str], None]
Body = dict[str, Any]

MS_PER_S = 1e3
KEPT_VIEWS = 16
"""Frames of an eye whose pose is kept until the GPU has finished them."""

RETRY_S = 1.0
SAY_AGAIN_S = 10.0
ASK_AGAIN = ("worker_crashed", "no_profile")
"""Codes of errors after which a profile is sent again."""

WAIT_SHARE = 0.6
"""Fraction of a frame's period for which the viewer waits for the newest result, so
that a fast filter's image is shown in the frame that it was rendered for."""

PATIENCE_S = 0.4
"""If the previous frame took no longer than this, the viewer always waits for the
filter. Frames that are late in any case are then half as old. On two shared cores,
frames of 896x1007 were 0.8 s old without this wait, and not more frequent."""

_OWN_STAGES = ("decode_ms", "queue_ms", "copy_out_ms", "rests_ms", "other_ms")
"""Stages that a service adds to the filter."""


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Frame to filter, with the state of both eyes."""

    due: DueFrame
    pictures: tuple[Picture, ...]
    eyes: tuple[EyeAndGaze, ...]
    begun_s: float

    @property
    def views(self) -> list[RgbdView]:
        """Return the views to filter."""
        return [RgbdView(p.color, p.depth_m, p.view.tangents) for p in self.pictures]

    @property
    def output(self) -> Output:
        """Return the format of the results, which equals the format of the images."""
        is_srgb = all(picture.color.dtype == np.uint8 for picture in self.pictures)
        return "srgb8" if is_srgb else "linear16"

    @property
    def states(self) -> tuple[ViewState, ...]:
        """Return the eye, pupil, focus, gaze and pose of each view."""
        return tuple(
            ViewState(
                picture.view.eye,
                eye.state.pupil_diameter_mm,
                eye.state.focus_dpt,
                eye.gaze_deg,
                picture.view.pose,
            )
            for picture, eye in zip(self.pictures, self.eyes, strict=True)
        )


@dataclass(frozen=True)
class FilteredStereoFrame:
    """Filtered frame.

    Attributes
    ----------
    frame : StereoFrame
        Input frame, with the views of the images.
    colors : tuple of (h, w, 3) uint8 or float16, or of moderngl.Texture
        Filtered image of each eye, sRGB or linear light as the input.
    used_focus_dpt : tuple of float or None
        Focus of each eye; None if the previous eye was used, whose focus does not apply
        to the requested eye.
    is_complete : bool
        Whether complete eyes were used.
    notes : tuple of str
        Notes of the filter.
    stages_ms : mapping
        Times of the filter, and of transport to and from it.
    """

    frame: StereoFrame
    colors: tuple[Image, ...]
    used_focus_dpt: tuple[float | None, ...]
    is_complete: bool = True
    notes: tuple[str, ...] = ()
    stages_ms: Mapping[str, float] = field(default_factory=dict)


class StereoFilter(ABC):
    """Filter of both eyes' frames, each eye through its own profile.

    `LocalFilter` filters in this process, `ServiceFilter` in a service.

    Parameters
    ----------
    settings : FilterSettings
        Settings of the eyes.
    say : callable
        Called with each message for the user, one line.

    Attributes
    ----------
    settings : FilterSettings
        Settings of the eyes, from the next change on.
    """

    def __init__(self, settings: FilterSettings, say: Say) -> None:
        self.settings, self._say = settings, say
        self._wanted: dict[EyeName, Body] = {}
        self._asked: dict[EyeName, tuple[int, Body]] = {}

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye; frames use the previous one until it is ready."""
        self._wanted[eye] = dict(profile)

    @abstractmethod
    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Submit a frame; return the newest result, or None before the first one."""

    def known(self, picture: Picture) -> Picture:
        """Return an image whose light and depth the eyes can follow without a wait.

        It is the image itself if that is in arrays, otherwise a smaller one of an
        earlier frame.
        """
        return picture

    @abstractmethod
    def restart(self) -> None:
        """Discard results, whose poses refer to the previous session."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources."""

    def _set_profiles(self, frame: StereoFrame) -> None:
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            eye = picture.view.eye
            profile = self._wanted.pop(eye, None)
            if profile is None:
                continue
            settings = self.settings
            if settings.gaze_deg == (0.0, 0.0):  # straight ahead of the head
                settings = settings.changed(gaze_deg=looking.ahead_deg)
            try:
                number = self._set_profile(eye, profile, settings, picture.camera)
                self._asked[eye] = number, profile
            except ValueError as error:
                self._say(f"{eye} eye: {error}")

    @abstractmethod
    def _set_profile(
        self, eye: Eye, body: Body, settings: FilterSettings, camera: Camera
    ) -> int:
        """Prepare an eye; return a number of the request, which results contain."""

    def _own_focus_dpt(
        self, eye: EyeName, number: int | None, focus_dpt: float | None
    ) -> float | None:
        """Return the focus of a result; None if it is not of the requested eye."""
        asked = self._asked.get(eye)
        return None if asked is None or asked[0] != number else focus_dpt


class LocalFilter(StereoFilter):
    """Filter of headset frames in this process, which returns each result at once.

    Parameters
    ----------
    settings, say
        As for `StereoFilter`.
    context : moderngl.Context, optional
        Context of the pictures.  Pictures in textures are then filtered to textures in
        it, without copies and without waiting for the GPU, unless an eye has effects
        that only frames of arrays have.
    """

    def __init__(
        self,
        settings: FilterSettings,
        say: Say,
        context: moderngl.Context | None = None,
    ) -> None:
        super().__init__(settings, say)
        self._context = context
        kind: Literal["own", "current"] = "own" if context is None else "current"
        with self._entered():
            self.filters: dict[EyeName, EyeFilter] = {
                eye: EyeFilter(
                    settings=settings,
                    on_event=partial(self._tell, eye),
                    gl_context=kind,
                )
                for eye in EYES
            }
        self._needs_arrays = False
        self._targets: dict[Eye, moderngl.Texture] = {}
        self._views: dict[int, EyeView] = {}  # of frames on the GPU, by number
        self._known: dict[Eye, RgbdPicture] = {}

    def _entered(self) -> AbstractContextManager[Any]:
        return nullcontext() if self._context is None else self._context

    def _tell(self, eye: Eye, event: EyeEvent) -> None:
        if isinstance(event, EyeReady):
            self._needs_arrays = False  # perhaps not of this eye
            self._say(f"{eye} eye: ready after {event.build_ms:.0f} ms")
        elif isinstance(event, EyeFailed) and not isinstance(
            event.error, BuildCancelled
        ):
            self._say(f"{eye} eye: {event.error}")

    def _set_profile(
        self, eye: Eye, body: Body, settings: FilterSettings, camera: Camera
    ) -> int:
        accepted = self.filters[eye].set_profile(
            body_of_eye(body, eye), settings=settings, views=[camera]
        )
        return accepted.generation

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Filter a frame; return None while an eye is being prepared for it.

        Raises
        ------
        FilterError
            If an eye cannot be prepared and there is no previous one.
        """
        begin_s = time.monotonic()
        self._set_profiles(frame)
        if self._takes_textures(frame):
            try:
                with self._entered():
                    return self._see_textures(frame, begin_s)
            except BadMessage as error:
                if error.field != "profile":
                    raise
                self._needs_arrays = True
                self._say(f"frames are copied for an eye that needs arrays: {error}")
        # Textures are read in the context that the filter enters afterward: moderngl
        # leaves none current.
        views = frame.views
        with self._entered():
            planned = plan_views(
                self.filters.__getitem__,
                views,
                frame.states,
                pupil_diameter_mm=frame.eyes[0].state.pupil_diameter_mm,
                focus_dpt=frame.eyes[0].state.focus_dpt,
            )
            seen = planned and planned.render(output=frame.output)
        if not seen:
            return None
        filter_ms = sum(seen.stage_times_ms.values())
        whole_ms = MS_PER_S * (time.monotonic() - begin_s)
        return FilteredStereoFrame(
            frame,
            tuple(view.color for view in seen.views),
            self._used_dpt(frame, seen.views),
            notes=seen.notes,
            stages_ms={"filter_ms": filter_ms, "around_ms": whole_ms - filter_ms},
        )

    def _takes_textures(self, frame: StereoFrame) -> bool:
        return (
            self._context is not None
            and not self._needs_arrays
            and all(isinstance(picture, TexturePicture) for picture in frame.pictures)
        )

    def _see_textures(
        self, frame: StereoFrame, begin_s: float
    ) -> FilteredStereoFrame | None:
        """Submit a frame in textures; the GPU filters it before it is shown."""
        shown: list[Filtered] = []
        targets = []
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            assert isinstance(picture, TexturePicture)
            targets.append(self._target(picture))
            found = self.filters[picture.view.eye].filter_textures(
                _texture_view(picture),
                GlTexture(targets[-1].glo, "rgba8"),
                pupil_diameter_mm=looking.state.pupil_diameter_mm,
                focus_dpt=looking.state.focus_dpt,
                gaze_deg=looking.gaze_deg,
            )
            if found:
                self._note(picture, found)
                shown.append(found)
        if len(shown) < len(frame.pictures):
            return None
        whole_ms = MS_PER_S * (time.monotonic() - begin_s)
        return FilteredStereoFrame(
            frame,
            tuple(targets),
            self._used_dpt(frame, shown),
            all(found.earlier is None or found.earlier.is_complete for found in shown),
            tuple(
                f"{picture.view.eye} eye: {note}"
                for picture, found in zip(frame.pictures, shown, strict=True)
                for note in found.notes
            ),
            {"filter_ms": whole_ms, "around_ms": 0.0},
        )

    def _used_dpt(
        self, frame: StereoFrame, found: Sequence[Any]
    ) -> tuple[float | None, ...]:
        return tuple(
            self._own_focus_dpt(picture.view.eye, view.generation, view.focus_dpt)
            for picture, view in zip(frame.pictures, found, strict=True)
        )

    def _target(self, picture: Picture) -> moderngl.Texture:
        """Return the texture for an eye's filtered image."""
        assert self._context is not None
        camera, eye = picture.camera, picture.view.eye
        size_px = camera.width_px, camera.height_px
        known = self._targets.get(eye)
        if known is None or known.size != size_px:
            if known is not None:
                known.release()
            known = self._targets[eye] = self._context.texture(size_px, 4)
        return known

    def _note(self, picture: Picture, found: Filtered) -> None:
        """Store the results of the newest frame that the GPU has finished."""
        self._views[found.number] = picture.view
        if found.earlier is None:
            return
        view = self._views.get(found.earlier.number)
        for number in [n for n in self._views if n < found.number - KEPT_VIEWS]:
            del self._views[number]
        if view is not None:
            sampled = found.earlier.sampled
            self._known[view.eye] = RgbdPicture(view, sampled.color, sampled.depth_m)

    def known(self, picture: Picture) -> Picture:
        """Return the sample of an eye's last image, or the image itself."""
        if not isinstance(picture, TexturePicture):
            return picture
        return self._known.get(picture.view.eye, picture)

    def restart(self) -> None:
        """Discard the samples of earlier frames."""
        self._known = {}

    def close(self) -> None:
        """Close the filters."""
        with self._entered():
            for eye_filter in self.filters.values():
                eye_filter.close()
            for target in self._targets.values():
                target.release()
        self._targets = {}


def _texture_view(picture: TexturePicture) -> TextureView:
    image, camera = picture.image, picture.camera
    return TextureView(
        GlTexture(image.color.glo, "rgba8"),
        GlTexture(image.depth_m.glo, "r32f"),
        camera.width_px,
        camera.height_px,
        camera.tangents,
        is_top_first=True,
    )


class ServiceFilter(StereoFilter):
    """Filter that sends frames to a service and returns the newest result.

    Parameters
    ----------
    endpoint : str
        Address of the service.
    settings, say
        As for `StereoFilter`.
    key_file : Path, optional
        Key file of the client, for a service that requires one.
    """

    def __init__(
        self,
        endpoint: str,
        settings: FilterSettings,
        say: Say,
        *,
        key_file: Path | None = None,
    ) -> None:
        super().__init__(settings, say)
        self._say_once = LogOnce(say)
        self._endpoint = endpoint
        self._client = FilterClient(
            endpoint, client_name="headset", key_file=key_file, timeout_s=5.0
        )
        self._retry_s = 0.0  # time before which no profile is sent
        self._on_way: dict[int | None, StereoFrame] = {}
        self._newest: FilteredStereoFrame | None = None
        self._is_there = True
        self._trip_s = math.inf  # round trip of the last result
        self.n_dropped: Counter[str] = Counter()

    def wait_for_service(self) -> None:
        """Wait until the service responds.

        Raises
        ------
        FilterError
            If the service does not respond or rejects this client.
        """
        self._client.hello()

    def _set_profile(
        self, eye: Eye, body: Body, settings: FilterSettings, camera: Camera
    ) -> int:
        return self._client.request_profile(
            body, eye=eye, settings=settings, views=[camera]
        )

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Send a frame and return the newest result.

        Returns
        -------
        FilteredStereoFrame or None
            None until the connected service has returned a result.
        """
        client = self._client
        self._take_events()
        if client.welcome is None:
            if self._is_there:
                self._say(
                    f"no filter service at {self._endpoint}: showing the scene "
                    "unfiltered and trying again"
                )
            self._is_there, self._newest = False, None
            return None
        if not self._is_there:
            self._say("connected to the filter service")
            self._is_there = True
        if time.monotonic() >= self._retry_s:
            self._set_profiles(frame)
        try:
            frame_id = client.submit(
                frame.views,
                pupil_diameter_mm=frame.eyes[0].state.pupil_diameter_mm,
                focus_dpt=frame.eyes[0].state.focus_dpt,
                states=frame.states,
                output=frame.output,
                display_time_ns=frame.due.display_time_ns,
            )
            self._on_way[frame_id] = frame
        except FilterError as error:
            self._say(f"a frame could not be sent: {error}")
        end_s = frame.begun_s + WAIT_SHARE * frame.due.period_s
        if self._trip_s <= PATIENCE_S:
            end_s = max(end_s, time.monotonic() + PATIENCE_S)
        self._take_events()
        while self._newest is None or self._newest.frame is not frame:
            wait_s = end_s - time.monotonic()
            if wait_s <= 0.0 or frame not in self._on_way.values():
                break
            self._take_events(wait_s)
        return self._newest

    def _take_events(self, wait_s: float = 0.0) -> None:
        for event in self._client.poll(wait_s):
            if isinstance(event, FilteredFrame):
                self._take(event)
            elif isinstance(event, Dropped):
                self._on_way.pop(event.frame_id, None)
                self.n_dropped[event.reason] += 1
            elif isinstance(event, ErrorReply):
                self._on_way.pop(event.frame_id, None)
                self._take_error(event)
            elif isinstance(event, Ready):
                self._say(f"{event.eye} eye: ready after {event.build_ms:.0f} ms")

    def _take_error(self, reply: ErrorReply) -> None:
        """Report an error once; send profiles again that the service has lost."""
        if reply.code == "build_cancelled":
            return
        self._say_once(str(reply.exception()))
        if reply.code not in ASK_AGAIN:
            return
        for eye, (profile_id, profile) in self._asked.items():
            # The service repeats the error of an eye for each frame.
            if eye not in self._wanted and reply.profile_id in (None, profile_id):
                self._wanted[eye] = profile
                self._retry_s = time.monotonic() + RETRY_S

    def _take(self, answer: FilteredFrame) -> None:
        frame = self._on_way.pop(answer.frame_id, None)
        if frame is None:
            return
        header = answer
        self._trip_s = answer.round_trip_ms / MS_PER_S
        own_ms = sum(header.stage_times_ms.get(name, 0.0) for name in _OWN_STAGES)
        self._newest = FilteredStereoFrame(
            frame,
            answer.colors,
            tuple(
                header.focus_dpt  # of a service that supports one eye only
                if view.profile_id is None
                else self._own_focus_dpt(view.eye, view.profile_id, view.focus_dpt)
                for view in header.views
            ),
            notes=header.notes,
            stages_ms={
                "filter_ms": header.total_ms - own_ms,
                "service_ms": own_ms,
                "wire_ms": answer.round_trip_ms - header.total_ms,
                "wait_ms": answer.age_ms - answer.round_trip_ms,
            },
        )

    def restart(self) -> None:
        """Discard the results and the frames in flight."""
        self._newest = None
        self._on_way = {}

    def close(self) -> None:
        """End the session."""
        self._client.close()


class LogOnce:
    """Callable that suppresses lines repeated within `SAY_AGAIN_S`."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._said_s: dict[str, float] = {}

    def __call__(self, line: str) -> None:
        """Report a line unless it was reported within `SAY_AGAIN_S`."""
        now_s = time.monotonic()
        self._said_s = {
            said: at_s
            for said, at_s in self._said_s.items()
            if now_s - at_s <= SAY_AGAIN_S
        }
        if line not in self._said_s:
            self._said_s[line] = now_s
            self._say(line)
