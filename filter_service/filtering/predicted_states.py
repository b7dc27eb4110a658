"""Prediction of pupil and focus of the next frames, from the last ones.

PSFs of predicted states are computed between frames, which saves time in the next one.
A wrong prediction cannot change an image, because a frame computes missing PSFs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from filter_service.rendering.sampled_frame import SampledFrame, SampledView
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State

SPEED_S = 0.25
"""Interval over which the speed of pupil and focus is measured."""

LEAD_S = (0.1, 0.3)
"""Prediction horizons: the next frame, and later ones."""


class FrameHistory:
    """The last frames of a stream."""

    def __init__(self) -> None:
        self._states: deque[tuple[float, State]] = deque()
        self.last: SampledFrame | None = None
        self.last_warmed: SampledFrame | None = None  # last with computed predictions

    def record(
        self,
        views: Sequence[RgbdView],
        state: State,
        *,
        at_s: float,
    ) -> None:
        """Add a frame that arrived at ``at_s``."""
        seen = tuple(SampledView.of(view) for view in views)
        self.record_sampled(lambda: seen, state, at_s=at_s)

    def record_sampled(
        self,
        sample: Callable[[], tuple[SampledView, ...]],
        state: State,
        *,
        at_s: float,
    ) -> None:
        """Add a frame, whose views are sampled only if PSFs are computed for them."""
        self.last = SampledFrame(at_s, state, sample)
        self._states.append((at_s, state))
        while self._states[0][0] < at_s - SPEED_S and len(self._states) > 2:
            self._states.popleft()

    @property
    def interval_s(self) -> float:
        """Return the mean interval of the last frames; 0 before the second."""
        if len(self._states) < 2:
            return 0.0
        return (self._states[-1][0] - self._states[0][0]) / (len(self._states) - 1)

    def predicted_states(self) -> list[State]:
        """Return the linearly extrapolated pupil and focus at each horizon."""
        if len(self._states) < 2:
            return []
        (first_s, first), (last_s, last) = self._states[0], self._states[-1]
        if last_s - first_s < 1e-3:
            return []
        found = []
        for lead_s in LEAD_S:
            steps = lead_s / (last_s - first_s)
            pupil_mm, focus_dpt = (
                getattr(last, name)
                + steps * (getattr(last, name) - getattr(first, name))
                for name in ("pupil_diameter_mm", "focus_dpt")
            )
            found.append(State(pupil_mm, focus_dpt))
        return found
