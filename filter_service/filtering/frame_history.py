"""The last frames of a stream, and pupil and focus of the next ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from filter_service.rendering.frame_kernels import SampledFrame, SampledView
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State

SPEED_S = 0.25
"""Interval over which the speed of pupil and focus is measured."""


class FrameHistory:
    """The last frames of a stream, which predict pupil and focus of the next ones.

    A wrong prediction cannot change an image: it only costs time.
    """

    def __init__(self) -> None:
        self._states: deque[tuple[float, State]] = deque()
        self.last: SampledFrame | None = None
        self.last_predicted: SampledFrame | None = None  # last with predictions

    def record(
        self,
        views: Sequence[RgbdView],
        state: State,
        *,
        at_s: float,
    ) -> None:
        """Add a frame that arrived at ``at_s``."""
        seen = [SampledView.later(view) for view in views]
        self.record_sampled(lambda: tuple(one() for one in seen), state, at_s=at_s)

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

    def predicted(self, lead_s: float) -> State | None:
        """Return the linearly extrapolated pupil and focus, or None without a speed.

        Parameters
        ----------
        lead_s : float
            Time after the last frame.
        """
        if len(self._states) < 2:
            return None
        (first_s, first), (last_s, last) = self._states[0], self._states[-1]
        if last_s - first_s < 1e-3:
            return None
        steps = lead_s / (last_s - first_s)
        pupil_mm, focus_dpt = (
            getattr(last, name) + steps * (getattr(last, name) - getattr(first, name))
            for name in ("pupil_diameter_mm", "focus_dpt")
        )
        return State(pupil_mm, focus_dpt, last.gaze_deg)
