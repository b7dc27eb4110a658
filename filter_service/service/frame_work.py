"""Filters one waiting frame: each view through its store, timed by stage."""

from __future__ import annotations

import logging
import time
from typing import Any

from filter_service.errors import FilterError, RenderFailed
from filter_service.messages import (
    LINEAR,
    LINEAR16,
    SRGB8,
    ErrorReply,
    Frame,
    Result,
    ResultView,
)
from filter_service.rendering.frame import View
from filter_service.service.session import RenderPlan, WaitingFrame

MS_PER_S = 1000.0

OUTPUTS = {SRGB8: "srgb8", LINEAR: "linear", LINEAR16: "linear16"}
"""Formats by the names that the renderer gives them."""

log = logging.getLogger("ocufilter")


def filter_frame(
    renderer: Any, waiting: WaitingFrame, plan: RenderPlan
) -> Result | ErrorReply:
    """Return the reply to a frame; anything that goes wrong becomes an error reply.

    Parameters
    ----------
    renderer : FilterRenderer or another with its ``render``
    """
    frame = waiting.frame
    started_s = time.monotonic()
    try:
        rendered = [
            _render_view(renderer, frame, i, store)
            for i, store in enumerate(plan.stores)
        ]
    except FilterError as error:
        return ErrorReply.from_exception(error, frame_id=frame.frame_id)
    except Exception as error:
        # The loop serves other clients too, so one frame must not end it.
        log.exception("frame %d could not be filtered", frame.frame_id)
        failure = RenderFailed(f"{type(error).__name__}: {error}")
        return ErrorReply.from_exception(failure, frame_id=frame.frame_id)
    stages_ms = {
        "decode_ms": MS_PER_S * (waiting.decoded_s - waiting.received_s),
        "queue_ms": MS_PER_S * (started_s - waiting.decoded_s),
    }
    for view in rendered:
        for name, value_ms in view.stage_times_ms.items():
            stages_ms[name] = stages_ms.get(name, 0.0) + float(value_ms)
    total_ms = MS_PER_S * (time.monotonic() - waiting.received_s)
    stages_ms["other_ms"] = total_ms - sum(stages_ms.values())
    return _result(frame, plan, rendered, total_ms, stages_ms)


def _render_view(renderer: Any, frame: Frame, index: int, store: Any) -> Any:
    header, images = frame.views[index], frame.images[index]
    view = View(
        color=images.color,
        depth_m=images.depth_m,
        tangents=header.camera.tangents,
        depth_kind=header.depth_kind,
        hidden_color=images.hidden_color,
        hidden_depth_m=images.hidden_depth_m,
    )
    return renderer.render(
        view,
        store,
        pupil_diameter_mm=frame.pupil_diameter_mm,
        focus_dpt=frame.focus_dpt,
        accumulation=frame.accumulation,
        merge=frame.merge,
        output=OUTPUTS[frame.output],
        gaze_deg=frame.gaze_deg,
    )


def _result(
    frame: Frame,
    plan: RenderPlan,
    rendered: list[Any],
    total_ms: float,
    stages_ms: dict[str, float],
) -> Result:
    notes = dict.fromkeys(note for view in rendered for note in view.notes)
    return Result(
        frame_id=frame.frame_id,
        profile_id=plan.eye.profile_id,
        generation=plan.eye.generation,
        views=tuple(
            ResultView(view.camera.width_px, view.camera.height_px, frame.output)
            for view in frame.views
        ),
        pupil_diameter_mm=float(rendered[0].pupil_diameter_mm),
        focus_dpt=float(rendered[0].focus_dpt),
        missing_depth_count=sum(int(v.missing_depth_count) for v in rendered),
        clamped_depth_count=sum(int(v.clamped_depth_count) for v in rendered),
        gaze_deg=tuple(float(angle) for angle in rendered[0].gaze_deg),
        overflow_count=sum(int(v.overflow_count) for v in rendered),
        total_ms=total_ms,
        stage_times_ms=stages_ms,
        notes=tuple(notes),
        is_complete=plan.is_complete,
        colors=tuple(view.color for view in rendered),
    )
