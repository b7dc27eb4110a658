"""Response of accommodation to changes of the fixation distance."""

from __future__ import annotations

from typing import Literal

from estimator.dynamics.delayed_approach import DelayedApproach

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
