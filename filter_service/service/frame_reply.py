"""Filters one frame and makes the reply to it."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from filter_service.errors import FilterError, RenderFailed
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.filtered import Filtered
from filter_service.messages import Dropped, ErrorReply, Frame, Result, ResultView
from filter_service.wire.images import OUTPUT_OF_FORMAT

MS_PER_S = 1000.0

log = logging.getLogger("ocufilter")


def frame_reply(
    eye_filter: EyeFilter, frame: Frame, out: Sequence[NDArray[Any]] | None
) -> Result | Dropped | ErrorReply:
    """Return the reply to a frame; anything that goes wrong becomes an error reply.

    Pictures may lie in ``out`` by then.  ``total_ms`` is for the caller to say: it
    knows when the frame came.
    """
    started_s = time.monotonic()
    try:
        seen = eye_filter.try_filter(
            [
                view.view(images)
                for view, images in zip(frame.views, frame.images, strict=True)
            ],
            pupil_diameter_mm=frame.pupil_diameter_mm,
            focus_dpt=frame.focus_dpt,
            gaze_deg=frame.gaze_deg,
            output=OUTPUT_OF_FORMAT[frame.output],
            accumulation=frame.options.accumulation,
            merge=frame.options.merge,
            render_tolerance=frame.options.render_tolerance,
            prepared_only=frame.options.prepared_only,
            out=out,
        )
    except FilterError as error:
        return ErrorReply.from_exception(error, frame_id=frame.frame_id)
    except Exception as error:
        # The loop serves other clients too, so one frame must not end it.
        log.exception("frame %d could not be filtered", frame.frame_id)
        failure = RenderFailed(f"{type(error).__name__}: {error}")
        return ErrorReply.from_exception(failure, frame_id=frame.frame_id)
    if seen is None:
        reason = "extending" if eye_filter.is_extending else "preparing"
        return Dropped(frame.frame_id, reason)
    total_ms = MS_PER_S * (time.monotonic() - started_s)
    return _result(frame, seen, total_ms)


def _result(frame: Frame, seen: Filtered, total_ms: float) -> Result:
    stages_ms = dict(seen.stage_times_ms)
    stages_ms["filter_other_ms"] = total_ms - sum(stages_ms.values())
    return Result(
        frame_id=frame.frame_id,
        profile_id=seen.profile_id,
        generation=seen.generation,
        views=tuple(
            ResultView(view.width_px, view.height_px, frame.output)
            for view in frame.views
        ),
        pupil_diameter_mm=seen.pupil_diameter_mm,
        focus_dpt=seen.focus_dpt,
        missing_depth_count=seen.missing_depth_count,
        clamped_depth_count=seen.clamped_depth_count,
        gaze_deg=seen.gaze_deg,
        overflow_count=seen.overflow_count,
        total_ms=0.0,
        stage_times_ms=stages_ms,
        notes=seen.notes,
        is_complete=seen.is_complete,
        colors=seen.colors,
    )
