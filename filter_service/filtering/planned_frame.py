"""Rendering of a frame whose eye is prepared."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from numpy.typing import NDArray

from filter_service.filtering.builder import Builder
from filter_service.filtering.filtered import Filtered
from filter_service.filtering.stream_eyes import RenderPlan, StreamEyes
from filter_service.rendering.engine import Rendered
from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.media_effects import MediaEffects, begin_through_media
from filter_service.rgbd_view import RgbdView
from filter_service.settings import Accumulation, Output

GazeDegrees = tuple[float, float] | None


@dataclass(frozen=True)
class PlannedFrame:
    """Views that one eye sees in one state, and the stores prepared for them."""

    builder: Builder  # the filter may be closed during the frame
    stream: StreamEyes
    plan: RenderPlan
    views: tuple[RgbdView, ...]
    pupil_diameter_mm: float
    focus_dpt: float

    def render(
        self,
        *,
        gazes_deg: Sequence[GazeDegrees],
        output: Output = "srgb8",
        accumulation: Accumulation = "coverage",
        merge: bool = True,
        render_tolerance: float = 1.0,
        out: Sequence[NDArray[Any] | None] | None = None,
        until_s: float | None = None,
    ) -> Filtered:
        """Filter the frame; `EyeFilter.filter` explains the arguments.

        Parameters
        ----------
        gazes_deg : one (h, v) for each view, or None
        out : sequence of arrays, optional
            Output arrays that may be used; only the returned arrays are valid.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed.

        Raises
        ------
        NotPrepared
            If PSFs that the frame needs were not computed by ``until_s``.
        RenderError
            If the engine failed.
        """
        return self.begin(
            gazes_deg=gazes_deg,
            output=output,
            accumulation=accumulation,
            merge=merge,
            render_tolerance=render_tolerance,
            out=out,
            until_s=until_s,
        )()

    def begin(
        self,
        *,
        gazes_deg: Sequence[GazeDegrees],
        out: Sequence[NDArray[Any] | None] | None = None,
        **options: Any,
    ) -> Callable[[], Filtered]:
        """Begin the frame; the returned function finishes it.

        It takes the arguments of `render`.  Frames of other eyes may be begun before
        this one is finished.
        """
        plan = self.plan
        rooms = out or [None] * len(self.views)
        started_s = time.monotonic()
        effects = MediaEffects.of(plan.eye.profile, plan.eye.settings.display)
        begun = [
            begin_through_media(
                self.builder.engine,
                view,
                store,
                effects,
                pupil_diameter_mm=self.pupil_diameter_mm,
                focus_dpt=self.focus_dpt,
                gaze_deg=gaze_deg,
                out=room,
                **options,
            )
            for view, store, gaze_deg, room in zip(
                self.views, plan.stores, gazes_deg, rooms, strict=True
            )
        ]
        return partial(self._finish, begun, started_s)

    def _finish(
        self, begun: Sequence[Callable[[], FilteredView]], started_s: float
    ) -> Filtered:
        rendered = [finish() for finish in begun]
        self.builder.frame_s = time.monotonic() - started_s
        self.builder.note_served(self.stream, self.plan)
        return _filtered(self.plan, rendered)


def _filtered(plan: RenderPlan, rendered: Sequence[Rendered]) -> Filtered:
    first = rendered[0]
    stages_ms: dict[str, float] = {}
    for view in rendered:
        for name, value_ms in view.stage_times_ms.items():
            stages_ms[name] = stages_ms.get(name, 0.0) + float(value_ms)
    return Filtered(
        colors=tuple(view.color for view in rendered),
        profile_id=plan.eye.profile_id,
        generation=plan.eye.generation,
        is_complete=True,
        pupil_diameter_mm=float(first.pupil_diameter_mm),
        focus_dpt=float(first.focus_dpt),
        gazes_deg=tuple(
            (float(h_deg), float(v_deg))
            for h_deg, v_deg in (view.gaze_deg for view in rendered)
        ),
        missing_depth_count=sum(int(v.missing_depth_count) for v in rendered),
        clamped_depth_count=sum(int(v.clamped_depth_count) for v in rendered),
        bad_color_count=sum(int(v.bad_color_count) for v in rendered),
        overflow_count=sum(int(v.overflow_count) for v in rendered),
        notes=tuple(dict.fromkeys(note for view in rendered for note in view.notes)),
        stage_times_ms=stages_ms,
    )
