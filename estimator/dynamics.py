"""Dynamics of the eye: pupil, accommodation and gaze over time.

Times are in seconds on any clock; each model is independent of the sampling rate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

REFERENCE_AGE_YEARS = 28.58
AGE_RANGE_YEARS = (20.0, 83.0)
ONE_EYE_RATIO = 0.1


def steady_pupil_mm(
    luminance_cd_m2: float,
    field_area_deg2: float,
    age_years: float,
    *,
    n_eyes: int = 2,
) -> float:
    """Return the diameter of the entrance pupil, mm, in steady light.

    Parameters
    ----------
    luminance_cd_m2 : float, 0 or more
        Mean luminance of the adapting field.
    field_area_deg2 : float, above 0
        Area of the field, 2827 deg² for a disc of 60 deg.
    age_years : float
        Age, clamped to the range of the formula, 20 to 83.
    n_eyes : 1 or 2
        Number of adapted eyes.  Monocular adaptation has a tenth of the effect.

    Raises
    ------
    ValueError
        A value is out of range.

    References
    ----------
    Watson & Yellott, J. Vision 12(10):12, 2012: the "unified formula".
    """
    if not (math.isfinite(luminance_cd_m2) and luminance_cd_m2 >= 0.0):
        raise ValueError(f"luminance_cd_m2 is {luminance_cd_m2}; allowed: 0 or more")
    if not (math.isfinite(field_area_deg2) and field_area_deg2 > 0.0):
        raise ValueError(f"field_area_deg2 is {field_area_deg2}; allowed: above 0")
    if n_eyes not in (1, 2):
        raise ValueError(f"n_eyes is {n_eyes}; allowed: 1 or 2")
    age_years = min(max(age_years, AGE_RANGE_YEARS[0]), AGE_RANGE_YEARS[1])
    eyes_ratio = 1.0 if n_eyes == 2 else ONE_EYE_RATIO
    flux: float = (luminance_cd_m2 * field_area_deg2 * eyes_ratio / 846.0) ** 0.41
    young_mm = 7.75 - 5.75 * flux / (flux + 2.0)
    years = age_years - REFERENCE_AGE_YEARS
    return young_mm + years * (0.02132 - 0.009562 * young_mm)


class DelayedApproach:
    """Exponential approach to a target after a latency.

    Parameters
    ----------
    value : float
        Initial value and target.
    latency_s : float
        Delay from a change of the target to the start of the response.
    time_constant_s : callable
        ``time_constant_s(value, target)``, called at the start of each response.
    """

    def __init__(
        self,
        value: float,
        latency_s: float,
        time_constant_s: Callable[[float, float], float],
    ) -> None:
        self._value, self._at_s = value, -math.inf
        self._latency_s = latency_s
        self._time_constant_s = time_constant_s
        self._target, self._tau_s = value, 1.0
        self._pending: deque[tuple[float, float]] = deque()  # start time, target

    def follow(
        self, target: float, at_s: float, latency_s: float | None = None
    ) -> float:
        """Set the target from ``at_s`` on; return the value then.

        Times before the last one are replaced by it.  Targets take effect in the order
        in which they were set.

        Parameters
        ----------
        target, at_s : float
        latency_s : float, optional
            Latency of this change; by default the latency of the constructor.

        Raises
        ------
        ValueError
            The target or the time is not finite.
        """
        if not math.isfinite(target) or not math.isfinite(at_s):
            raise ValueError(f"target {target} at {at_s} s; allowed: finite numbers")
        at_s = max(at_s, self._at_s)
        value = self.value_at(at_s)
        latest = self._pending[-1][1] if self._pending else self._target
        if target != latest:
            start_s = at_s + (self._latency_s if latency_s is None else latency_s)
            if self._pending:
                start_s = max(start_s, self._pending[-1][0])
            self._pending.append((start_s, target))
            value = self.value_at(at_s)  # in case of zero latency
        return value

    def value_at(self, at_s: float) -> float:
        """Return the value at a time; times before the last one are replaced by it."""
        while self._pending and self._pending[0][0] <= at_s:
            start_s, target = self._pending.popleft()
            self._approach(start_s)
            self._target = target
            self._tau_s = self._time_constant_s(self._value, target)
        self._approach(at_s)
        return self._value

    def hold(self, low: float, high: float) -> None:
        """Clamp the value to limits; a clamped value starts a new response."""
        clamped = min(max(self._value, low), high)
        if clamped != self._value:
            self._value = clamped
            self._tau_s = self._time_constant_s(clamped, self._target)

    def _approach(self, at_s: float) -> None:
        if at_s > self._at_s:
            if math.isfinite(self._at_s):
                share = math.exp(-(at_s - self._at_s) / self._tau_s)
                self._value = self._target + (self._value - self._target) * share
            self._at_s = at_s


LATENCY_AT_1_CD_M2_S = 0.270
LATENCY_PER_LOG_UNIT_S = 0.034
LATENCY_RANGE_S = (0.20, 0.36)
"""Latency falls by 34 ms per log unit of luminance (Myers & Stark 1993).  At 1 cd/m² it
equals Link & Stark's formula for a step."""

FAST_SHARE = 0.4
CONSTRICTING_S = (0.28, 0.28)
DILATING_S = (0.9, 2.9)
"""Time constants of the fast and the slow component; only redilation has two.  They are
fitted, to 0.14 mm, to responses to pulses of 1 s at five light levels (data of Martin,
Pinto, Bulte & Spitschan, 2021)."""


def reflex_latency_s(luminance_cd_m2: float) -> float:
    """Return the latency of the reflex at a luminance."""
    log_light = math.log10(max(luminance_cd_m2, 1e-9))
    latency_s = LATENCY_AT_1_CD_M2_S - LATENCY_PER_LOG_UNIT_S * log_light
    return min(max(latency_s, LATENCY_RANGE_S[0]), LATENCY_RANGE_S[1])


class PupilReflex:
    """Pupil that follows the luminance of the scene.

    Parameters
    ----------
    age_years, field_area_deg2, n_eyes
        Arguments of `steady_pupil_mm`, which gives the target diameter.
    luminance_cd_m2 : float
        Initial luminance, to which the pupil is adapted.
    latency_s : float, optional
        Measured latency of the person; `reflex_latency_s` by default.
    """

    def __init__(
        self,
        age_years: float,
        field_area_deg2: float,
        luminance_cd_m2: float,
        *,
        n_eyes: int = 2,
        latency_s: float | None = None,
    ) -> None:
        self._adaptation = field_area_deg2, age_years, n_eyes
        self._latency_s = latency_s
        begin_mm = self._steady_mm(luminance_cd_m2)
        self._parts = tuple(
            DelayedApproach(
                begin_mm,
                LATENCY_AT_1_CD_M2_S,
                cast(
                    "Callable[[float, float], float]",
                    lambda value, target, part=part: (
                        CONSTRICTING_S[part] if target < value else DILATING_S[part]
                    ),
                ),
            )
            for part in range(2)
        )

    def _steady_mm(self, luminance_cd_m2: float) -> float:
        field_area_deg2, age_years, n_eyes = self._adaptation
        return steady_pupil_mm(
            luminance_cd_m2, field_area_deg2, age_years, n_eyes=n_eyes
        )

    def follow(self, luminance_cd_m2: float, at_s: float) -> float:
        """Set the luminance from ``at_s`` on; return the diameter then, mm."""
        target_mm = self._steady_mm(luminance_cd_m2)
        latency_s = self._latency_s
        if latency_s is None:
            latency_s = reflex_latency_s(luminance_cd_m2)
        fast_mm, slow_mm = (
            part.follow(target_mm, at_s, latency_s) for part in self._parts
        )
        return FAST_SHARE * fast_mm + (1.0 - FAST_SHARE) * slow_mm


Cue = Literal["both", "blur"]

LATENCY_S = 0.36
"""Latency (Campbell & Westheimer 1960).  It does not change with age from 18 to 49
years (Heron, Charman & Gray 2002)."""

PEAK_SPEED_PER_DPT = {"both": 3.56, "blur": 7.10}
"""Slope of the main sequence, dpt/s per dpt, for binocular viewing (driven by vergence)
and for monocular viewing (driven by blur alone).  ARVO 2007, article 2407307."""

RELAXING_SPEED_PER_DPT, RELAXING_SPEED_DPT_S = 1.39, 1.12
"""Slope and intercept of the peak speed of disaccommodation, which depends on the
initial accommodation and not on the step size (Bharadwaj & Schor 2006)."""

PLANT_S = 0.156
"""Time constant of the plant, lens and ciliary muscle (Schor & Bharadwaj 2006); no
response is faster."""


def time_constant_s(begin_dpt: float, end_dpt: float, cue: Cue = "both") -> float:
    """Return the time constant of an exponential step of accommodation.

    It is the step size divided by the peak speed.  The plant limits small steps.

    Parameters
    ----------
    begin_dpt, end_dpt : float
        Initial and final accommodation, 0 if relaxed.
    cue : {"both", "blur"}
        Binocular viewing, driven by vergence, or monocular viewing, driven by blur.
    """
    if end_dpt >= begin_dpt:
        return max(PLANT_S, 1.0 / PEAK_SPEED_PER_DPT[cue])
    speed_dpt_s = RELAXING_SPEED_PER_DPT * max(begin_dpt, 0.0) + RELAXING_SPEED_DPT_S
    return max(PLANT_S, (begin_dpt - end_dpt) / speed_dpt_s)


class AccommodationResponse:
    """Accommodation that follows the fixation distance.

    In the steady state, the eye is focused at the fixation distance: acuity is best at
    or near it, despite the lag that autorefractors report (Labhishetty, Cholewiak,
    Roorda & Banks, J. Vision 21(3):21, 2021).  Age limits the amplitude, but the speed
    hardly changes from 18 to 49 years (Heron, Charman & Gray, IOVS 40:2872, 1999;
    Heron, Charman & Schor 2001).

    Parameters
    ----------
    far_dpt, near_dpt : float
        Far and near point through the correction; see `Focusing.focus_limits_dpt`.
    cue : {"both", "blur"}
        Binocular viewing, driven by vergence, or monocular viewing, driven by blur.

    Raises
    ------
    ValueError
        The cue is unknown, or the near point is beyond the far point.
    """

    def __init__(self, far_dpt: float, near_dpt: float, *, cue: Cue = "both") -> None:
        if cue not in PEAK_SPEED_PER_DPT:
            allowed = ", ".join(PEAK_SPEED_PER_DPT)
            raise ValueError(f"cue is {cue!r}; allowed: {allowed}")
        if not near_dpt >= far_dpt:
            raise ValueError(f"near_dpt is {near_dpt}; allowed: {far_dpt} or more")
        self.far_dpt, self.near_dpt = far_dpt, near_dpt
        self._response = DelayedApproach(
            0.0, LATENCY_S, lambda begin, end: time_constant_s(begin, end, cue)
        )

    def hold(self, far_dpt: float, near_dpt: float) -> None:
        """Limit accommodation to the present far and near point, dpt.

        Both change with the pupil.
        """
        self._response.hold(far_dpt - self.far_dpt, near_dpt - self.far_dpt)

    def follow(self, distance_dpt: float, at_s: float) -> float:
        """Set the fixation distance from ``at_s`` on; return the focus then, dpt."""
        target_dpt = min(max(distance_dpt, self.far_dpt), self.near_dpt)
        return self.far_dpt + self._response.follow(target_dpt - self.far_dpt, at_s)


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
