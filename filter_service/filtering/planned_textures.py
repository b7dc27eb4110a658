"""Rendering of a frame in textures whose eye is ready."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from filter_service.errors import BadMessage, RenderFailed
from filter_service.filtering.builder import Builder
from filter_service.filtering.filtered import Filtered, ViewResult
from filter_service.filtering.stream_eyes import Preparing, RenderPlan, StreamEyes
from filter_service.rendering.engine import (
    ShownTexture,
    TextureEngine,
    TextureImporter,
    TextureRequest,
)
from filter_service.rendering.filtered_view import FrameCounts
from filter_service.rendering.media_effects import UNCHANGED
from filter_service.rendering.sampled_frame import SampledView
from filter_service.settings import DEFAULT_OPTIONS, RenderOptions
from filter_service.texture_view import GlTexture, TextureView
from filter_service.view_state import State

TargetedView = tuple[TextureView, GlTexture]
"""A view and the texture for its filtered image."""

NO_IMAGE = np.empty((0, 0, 3), np.uint8)


def texture_engine(builder: Builder) -> TextureEngine:
    """Return the engine of a builder, which filters textures.

    Raises
    ------
    RenderFailed
        If it does not.
    """
    if not isinstance(builder.engine, TextureEngine):
        raise RenderFailed("frames in textures need the engine gl")
    return builder.engine


def texture_importer(builder: Builder) -> TextureImporter | None:
    """Return the engine of a builder if it imports textures of other processes."""
    engine = builder.engine
    if isinstance(engine, TextureImporter) and engine.texture_support is not None:
        return engine
    return None


@dataclass(frozen=True)
class PlannedTextures:
    """Views of one eye, their states, and the stores that render them."""

    builder: Builder
    stream: StreamEyes
    plan: RenderPlan
    views: tuple[TargetedView, ...]
    states: tuple[State, ...]

    def begin(
        self,
        *,
        options: RenderOptions = DEFAULT_OPTIONS,
        until_s: float | None = None,
        **_: Any,
    ) -> Callable[[], Filtered | Preparing]:
        """Return a function that renders all views and waits for them.

        The result has no images, which are in the textures.  Other parameters and the
        errors are those of `PlannedFrame.begin`.
        """
        return partial(self._render, options, until_s)

    def _render(
        self,
        options: RenderOptions,
        until_s: float | None,
    ) -> Filtered | Preparing:
        shown = []
        for index in range(len(self.views)):
            view = self.show(index, options=options, waits=True, until_s=until_s)
            if view is None:
                return Preparing("extending", stage="psfs")
            shown.append(view)
        eye = self.plan.eye
        counts = [view.earlier.counts for view in shown if view.earlier is not None]
        return Filtered(
            views=tuple(
                ViewResult(NO_IMAGE, "both", eye.profile_id, eye.generation, view.state)
                for view in shown
            ),
            notes=tuple(dict.fromkeys(note for view in shown for note in view.notes)),
            stage_times_ms={},
            **{
                count.name: sum(found[count.name] for found in counts)
                for count in fields(FrameCounts)
            },
        )

    def show(
        self,
        index: int,
        *,
        options: RenderOptions,
        target_is_top_first: bool | None = None,
        waits: bool = False,
        until_s: float | None = None,
    ) -> ShownTexture | None:
        """Render one view; the parameters are those of `TextureRequest`.

        Returns None if the frame waits, and PSFs were not computed by ``until_s``.

        Raises
        ------
        BadMessage
            If textures do not fit, or the profile has effects that need arrays.
        RenderError
        """
        view, target = self.views[index]
        effects = self.plan.eye.media_effects
        if effects is not None and effects.need_arrays is not None:
            raise BadMessage(
                f"it has {effects.need_arrays}",
                field="profile",
                allowed="none for frames in textures; filter frames of arrays",
            )
        started_s = time.monotonic()
        shown = texture_engine(self.builder).filter_textures(
            TextureRequest(
                view,
                target,
                self.plan.stores[index],
                self.states[index],
                target_is_top_first=(
                    view.is_top_first
                    if target_is_top_first is None
                    else target_is_top_first
                ),
                gain_ratio=UNCHANGED if effects is None else effects.gain_ratio,
                options=self.plan.eye.settings.frame_options(options),
                waits=waits,
                until_s=until_s,
            )
        )
        if shown is None:
            return None
        self.builder.frame_s = time.monotonic() - started_s
        self.builder.mark_rendered(self.stream, self.plan)
        earlier = shown.earlier
        if earlier is not None:
            self.stream.history.record_sampled(
                lambda: (SampledView.of_samples(view.camera, earlier.sampled),),
                self.states[index],
                at_s=started_s,
            )
        return shown
