"""Filtering of a frame whose images are in textures that the client shares."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.filtered import Filtered
from filter_service.filtering.planned_textures import TargetedView
from filter_service.filtering.several_eyes import plan_views
from filter_service.filtering.stream_eyes import Preparing
from filter_service.messages import (
    LINEAR16,
    SRGB8,
    EyeName,
    Frame,
    Reply,
    Result,
    ViewHeader,
    ViewTextures,
)
from filter_service.service.frame_reply import PSF_BUDGET_S, reply_to_frame
from filter_service.texture_view import GlTexture, TextureView


def filter_in_textures(
    filter_of: Callable[[EyeName], EyeFilter],
    frame: Frame,
    textures: Mapping[int, GlTexture],
) -> Reply:
    """Filter a frame, wait for the GPU and return the reply.

    Parameters
    ----------
    filter_of : callable
        Returns the filter of an eye.
    frame : Frame
    textures : mapping
        Imported textures by their number.
    """
    started_s = time.monotonic()

    def filtered() -> Filtered | Preparing:
        planned = plan_views(
            filter_of,
            [
                targeted_view(view, used, textures)
                for view, used in zip(frame.views, frame.textures, strict=True)
            ],
            [view.state for view in frame.views],
            pupil_diameter_mm=frame.pupil_diameter_mm,
            focus_dpt=frame.focus_dpt,
            gaze_deg=frame.gaze_deg,
            plan=EyeFilter.plan_textures,
        )
        if isinstance(planned, Preparing):
            return planned
        return planned.render(
            until_s=started_s + PSF_BUDGET_S, **frame.options.render_values
        )

    reply = reply_to_frame(frame, filtered)
    if not isinstance(reply, Result):
        return reply
    targets = [textures[used.result].format for used in frame.textures]
    return replace(
        reply,
        colors=(),
        views=tuple(
            replace(view, color=LINEAR16 if target == "rgba16f" else SRGB8)
            for view, target in zip(reply.views, targets, strict=True)
        ),
    )


def targeted_view(
    header: ViewHeader, used: ViewTextures, textures: Mapping[int, GlTexture]
) -> TargetedView:
    """Return a view in textures, and the texture for its result.

    Raises
    ------
    BadMessage
        If a texture is not imported, or the formats do not suit.
    """
    missing = [number for number in used.numbers if number not in textures]
    if missing:
        raise BadMessage(
            f"texture {missing[0]} is not shared",
            field="textures",
            allowed="textures that the service has imported",
        )
    view = TextureView(
        textures[used.color],
        textures[used.depth],
        header.width_px,
        header.height_px,
        header.tangents,
        used.projection,
        is_top_first=used.is_top_first,
        white_ratio=used.white_ratio,
    )
    return view, textures[used.result]
