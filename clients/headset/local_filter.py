"""Filtering of headset frames in this process, in textures or in arrays."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from clients.headset.runtime import EYES, Eye, EyeView
from clients.headset.stereo_filter import (
    FilteredStereoFrame,
    Say,
    StereoFrame,
    settings_for_gaze,
)
from clients.headset.stereo_gaze import Picture, RgbdPicture, TexturePicture
from filter_service import (
    BadMessage,
    BuildingEye,
    EyeFailed,
    EyeFilter,
    EyeReady,
    FilteredTexture,
    FilterSettings,
    GlTexture,
    RgbdView,
    TextureView,
    plan_views,
)
from filter_service.errors import BuildCancelled
from filter_service.messages import EyeName, body_of_eye

if TYPE_CHECKING:
    import moderngl

MS_PER_S = 1e3
KEPT_VIEWS = 16
"""Frames of an eye whose pose is kept until the GPU has finished them."""

EyeEvent = BuildingEye | EyeFailed | EyeReady


class LocalFilter:
    """Filter of headset frames in this process, which returns each result at once.

    Parameters
    ----------
    settings : FilterSettings
        Settings of the filters.
    say : callable
        Called with each message about the eyes, one line.
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
        self._say = say
        self.settings = settings
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
        self._wanted: dict[Eye, Mapping[str, Any]] = {}
        self._generations: dict[Eye, int] = {}
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

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye; frames use the previous one until it is ready."""
        self._wanted[eye] = profile

    def _set_profiles(self, frame: StereoFrame) -> None:
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            eye = picture.view.eye
            profile = self._wanted.pop(eye, None)
            if profile is None:
                continue
            try:
                accepted = self.filters[eye].set_profile(
                    body_of_eye(profile, eye),
                    settings=settings_for_gaze(self.settings, looking),
                    cameras=[picture.camera],
                )
                self._generations[eye] = accepted.generation
            except ValueError as error:
                self._say(f"{eye} eye: {error}")

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
            return self._see_arrays(frame, views, begin_s)

    def _takes_textures(self, frame: StereoFrame) -> bool:
        return (
            self._context is not None
            and not self._needs_arrays
            and all(isinstance(picture, TexturePicture) for picture in frame.pictures)
        )

    def _see_arrays(
        self, frame: StereoFrame, views: list[RgbdView], begin_s: float
    ) -> FilteredStereoFrame | None:
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
        stages_ms = seen.stage_times_ms
        whole_ms = MS_PER_S * (time.monotonic() - begin_s)
        return FilteredStereoFrame(
            frame,
            tuple(picture.view for picture in frame.pictures),
            tuple(view.color for view in seen.views),
            tuple(
                self._used_dpt(picture, view.generation, view.focus_dpt)
                for view, picture in zip(seen.views, frame.pictures, strict=True)
            ),
            True,
            seen.notes,
            {
                "filter_ms": sum(stages_ms.values()),
                "around_ms": whole_ms - sum(stages_ms.values()),
            },
        )

    def _used_dpt(
        self, picture: Picture, generation: int, focus_dpt: float
    ) -> float | None:
        is_own = generation == self._generations.get(picture.view.eye)
        return focus_dpt if is_own else None

    def _see_textures(
        self, frame: StereoFrame, begin_s: float
    ) -> FilteredStereoFrame | None:
        """Submit a frame in textures; the GPU filters it before it is shown."""
        shown: list[FilteredTexture] = []
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            eye = picture.view.eye
            assert isinstance(picture, TexturePicture)
            found = self.filters[eye].filter_textures(
                _texture_view(picture),
                GlTexture(self._target(picture).glo, "rgba8"),
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
            tuple(picture.view for picture in frame.pictures),
            tuple(self._target(picture) for picture in frame.pictures),
            tuple(
                self._used_dpt(picture, found.generation, found.focus_dpt)
                for picture, found in zip(frame.pictures, shown, strict=True)
            ),
            all(found.earlier is None or found.earlier.is_complete for found in shown),
            tuple(
                f"{picture.view.eye} eye: {note}"
                for picture, found in zip(frame.pictures, shown, strict=True)
                for note in found.notes
            ),
            {"filter_ms": whole_ms, "around_ms": 0.0},
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

    def _note(self, picture: Picture, found: FilteredTexture) -> None:
        """Keep what is known of the newest frame that the GPU has finished."""
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
        """Return what is known of an eye's last image, or the image itself."""
        if not isinstance(picture, TexturePicture):
            return picture
        return self._known.get(picture.view.eye, picture)

    def restart(self) -> None:
        """Discard what is known of earlier frames."""
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
