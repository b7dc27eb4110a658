"""Filtering of a frame, and its reply."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

from numpy.typing import NDArray

from filter_service.errors import FilterError, RenderFailed
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.filtered import Filtered
from filter_service.filtering.several_eyes import plan_views
from filter_service.filtering.stream_eyes import Preparing
from filter_service.messages import (
    Dropped,
    ErrorReply,
    EyeName,
    Frame,
    Result,
    ResultView,
)
from filter_service.wire.images import OUTPUT_OF_FORMAT

MS_PER_S = 1000.0

PSF_BUDGET_S = 1.0
"""Time limit of a frame for computing PSFs, beyond which it is dropped.  The next frame
keeps what was computed.  A first frame of 1280x720 takes 0.3 to 0.7 s of two cores."""

log = logging.getLogger("ocufilter")


def frame_reply(
    filter_of: Callable[[EyeName], EyeFilter],
    frame: Frame,
    out: Sequence[NDArray[Any]] | None,
) -> Result | Dropped | ErrorReply:
    """Filter a frame and return the reply; any failure becomes an error reply.

    The caller sets ``total_ms``, because it knows when the frame arrived.

    Parameters
    ----------
    filter_of : callable
        Returns the filter of an eye.
    frame : Frame
    out : sequence of arrays, optional
        Output arrays, (height, width, 3) each, that the engine may write to.
    """
    started_s = time.monotonic()

    def filtered() -> Filtered | Preparing:
        planned = plan_views(
            filter_of,
            [
                view.view(images)
                for view, images in zip(frame.views, frame.images, strict=True)
            ],
            [view.state for view in frame.views],
            pupil_diameter_mm=frame.pupil_diameter_mm,
            focus_dpt=frame.focus_dpt,
            gaze_deg=frame.gaze_deg,
        )
        if isinstance(planned, Preparing):
            return planned
        return planned.render(
            output=OUTPUT_OF_FORMAT[frame.output],
            out=out,
            until_s=started_s + PSF_BUDGET_S,
            **frame.options.render_values,
        )

    return reply_to_frame(frame, filtered)


def reply_to_frame(
    frame: Frame, filter_frame: Callable[[], Filtered | Preparing]
) -> Result | Dropped | ErrorReply:
    """Call a function that filters a frame, and return the reply; see `frame_reply`.

    Parameters
    ----------
    frame : Frame
    filter_frame : callable
        Returns the filtered frame, or why it cannot be filtered yet.
    """
    started_s = time.monotonic()
    try:
        filtered = filter_frame()
        if isinstance(filtered, Preparing):
            return Dropped(frame.frame_id, filtered.reason)
    except FilterError as error:
        return ErrorReply.from_exception(error, frame_id=frame.frame_id)
    except Exception as error:
        # One frame must not stop the worker, which serves other clients too.
        log.exception("frame %d could not be filtered", frame.frame_id)
        failure = RenderFailed(f"{type(error).__name__}: {error}")
        return ErrorReply.from_exception(failure, frame_id=frame.frame_id)
    total_ms = MS_PER_S * (time.monotonic() - started_s)
    return _result(frame, filtered, total_ms)


def _result(frame: Frame, filtered: Filtered, total_ms: float) -> Result:
    stages_ms = dict(filtered.stage_times_ms)
    stages_ms["filter_other_ms"] = total_ms - sum(stages_ms.values())
    names = {field.name for field in fields(Result)}
    counts: dict[str, Any] = {n: c for n, c in filtered.counts.items() if n in names}
    return Result(
        frame_id=frame.frame_id,
        profile_id=filtered.profile_id,
        generation=filtered.generation,
        views=tuple(
            ResultView(
                header.width_px,
                header.height_px,
                frame.output,
                header.eye,
                profile_id=found.profile_id,
                generation=found.generation,
                is_complete=True,
                pupil_diameter_mm=found.pupil_diameter_mm,
                focus_dpt=found.focus_dpt,
                gaze_deg=found.gaze_deg,
                pose=header.pose,
            )
            for header, found in zip(frame.views, filtered.views, strict=True)
        ),
        pupil_diameter_mm=filtered.pupil_diameter_mm,
        focus_dpt=filtered.focus_dpt,
        gaze_deg=filtered.gaze_deg,
        total_ms=0.0,
        stage_times_ms=stages_ms,
        notes=filtered.notes,
        display_time_ns=frame.display_time_ns,
        colors=filtered.colors,
        **counts,
    )
