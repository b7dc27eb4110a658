"""Gaze of an eye tracker: smoothed, and straight ahead while tracking is lost."""

from __future__ import annotations

import math
from dataclasses import dataclass

MIN_CUTOFF_HZ = 2.0
SPEED_WEIGHT = 0.1
"""Increase of the cutoff, Hz per deg/s: in fixations, the filter removes noise above
2 Hz; in a saccade of 300 deg/s, its delay is at most 5 ms."""

SPEED_CUTOFF_HZ = 1.0
BLINK_S = 0.4
"""Time for which the last gaze is held: a blink takes 0.1 to 0.4 s."""

STRAIGHT_AHEAD_DEG = (0.0, 0.0)


@dataclass(frozen=True)
class Gaze:
    """Gaze direction of an eye.

    Attributes
    ----------
    h_deg, v_deg : float
        Angles to the right and up from the camera's axis.
    is_tracked : bool
        Whether the gaze is known; otherwise it is straight ahead.
    age_s : float
        Age of the last sample; infinite before the first.
    """

    h_deg: float
    v_deg: float
    is_tracked: bool
    age_s: float


class GazeFollower:
    """Gaze smoothed with the 1 euro filter.

    The cutoff of this low-pass filter rises with speed, so that fixations do not jitter
    and saccades are not delayed.

    Parameters
    ----------
    min_cutoff_hz : float
        Cutoff at zero speed.
    speed_weight : float
        Increase of the cutoff, Hz per deg/s.
    max_age_s : float
        Age above which a sample is not used.

    Raises
    ------
    ValueError
        A parameter is out of range.

    References
    ----------
    Casiez, Roussel & Vogel, CHI 2012.
    """

    def __init__(
        self,
        *,
        min_cutoff_hz: float = MIN_CUTOFF_HZ,
        speed_weight: float = SPEED_WEIGHT,
        max_age_s: float = BLINK_S,
    ) -> None:
        for name, value in (
            ("min_cutoff_hz", min_cutoff_hz),
            ("max_age_s", max_age_s),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; allowed: above 0")
        if not (math.isfinite(speed_weight) and speed_weight >= 0.0):
            raise ValueError(f"speed_weight is {speed_weight}; allowed: 0 or more")
        self._min_cutoff_hz = min_cutoff_hz
        self._speed_weight = speed_weight
        self._max_age_s = max_age_s
        self._gaze_deg: tuple[float, float] | None = None
        self._speed_deg_s = (0.0, 0.0)
        self._at_s = -math.inf

    def see(self, h_deg: float, v_deg: float, at_s: float) -> None:
        """Add a sample; samples that are not finite or not newer are ignored."""
        if not all(map(math.isfinite, (h_deg, v_deg, at_s))) or at_s <= self._at_s:
            return
        step_s = at_s - self._at_s
        previous_deg, self._at_s = self._gaze_deg, at_s
        if previous_deg is None or step_s > self._max_age_s:
            self._gaze_deg, self._speed_deg_s = (h_deg, v_deg), (0.0, 0.0)
            return
        weight = _filter_weight(SPEED_CUTOFF_HZ, step_s)
        self._speed_deg_s = (
            _interpolated(
                self._speed_deg_s[0], (h_deg - previous_deg[0]) / step_s, weight
            ),
            _interpolated(
                self._speed_deg_s[1], (v_deg - previous_deg[1]) / step_s, weight
            ),
        )
        # One cutoff for both axes: otherwise an oblique saccade would be curved.
        cutoff_hz = self._min_cutoff_hz + self._speed_weight * math.hypot(
            *self._speed_deg_s
        )
        weight = _filter_weight(cutoff_hz, step_s)
        self._gaze_deg = (
            _interpolated(previous_deg[0], h_deg, weight),
            _interpolated(previous_deg[1], v_deg, weight),
        )

    def at(self, at_s: float) -> Gaze:
        """Return the gaze at a time."""
        age_s = at_s - self._at_s
        if self._gaze_deg is None or age_s > self._max_age_s:
            return Gaze(*STRAIGHT_AHEAD_DEG, is_tracked=False, age_s=age_s)
        return Gaze(*self._gaze_deg, is_tracked=True, age_s=max(0.0, age_s))


def _filter_weight(cutoff_hz: float, step_s: float) -> float:
    """Return the weight of a new sample in a first-order low-pass filter."""
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff_hz * step_s))


def _interpolated(before: float, new: float, weight: float) -> float:
    return before + weight * (new - before)
