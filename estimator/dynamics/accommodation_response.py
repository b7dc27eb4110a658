"""Response of an eye's accommodation over time."""

from __future__ import annotations

from typing import Literal

from estimator.dynamics.delayed_approach import DelayedApproach

Cue = Literal["both", "blur"]

LATENCY_S = 0.36
"""Latency (Campbell & Westheimer 1960); from 18 to 49 years it does not change with age
(Heron, Charman & Gray 2002)."""

PEAK_SPEED_PER_DPT = {"both": 3.56, "blur": 7.10}
"""Main sequence, dpt/s per diopter: of accommodation driven by vergence, with both
eyes, and of one eye's by blur alone (ARVO 2007, article 2407307)."""

RELAXING_SPEED_PER_DPT, RELAXING_SPEED_DPT_S = 1.39, 1.12
"""Coefficients of the peak speed of relaxation, which depends on its start and not on
its size (Bharadwaj & Schor 2006)."""

PLANT_S = 0.156
"""Time constant of lens and ciliary muscle alone (Schor & Bharadwaj 2006), the lower
limit."""


def time_constant_s(begin_dpt: float, end_dpt: float, cue: Cue = "both") -> float:
    """Return the time constant of a step of accommodation, which is exponential.

    It is the step's size divided by its peak speed.  Relaxation from near is faster,
    and lens and muscle limit the speed of small steps.

    Parameters
    ----------
    begin_dpt, end_dpt : float
        Accommodation, 0 if relaxed.
    cue : "both" or "blur"
        Both eyes, driven by vergence, or blur alone.
    """
    if end_dpt >= begin_dpt:
        return max(PLANT_S, 1.0 / PEAK_SPEED_PER_DPT[cue])
    speed_dpt_s = RELAXING_SPEED_PER_DPT * max(begin_dpt, 0.0) + RELAXING_SPEED_DPT_S
    return max(PLANT_S, (begin_dpt - end_dpt) / speed_dpt_s)


class AccommodationResponse:
    """Accommodation that follows the distance of the fixated object.

    In the steady state the eye is focused at that distance: acuity is best at or near
    it, despite the lag that refractors report (Labhishetty, Cholewiak, Roorda & Banks,
    J. Vision 21(3):21, 2021).  Age limits the amplitude and not the speed: the speed of
    steps hardly changes from 18 to 49 years (Heron, Charman & Gray, IOVS 40:2872, 1999;
    Heron, Charman & Schor 2001).

    Parameters
    ----------
    far_dpt, near_dpt : float
        Far and near point through the correction, see `Focusing.focus_limits_dpt`.
    cue : "both" or "blur"
        Both eyes, driven by vergence, or blur alone.
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
        """Limit accommodation to the range between an actual far and near point."""
        self._response.hold(far_dpt - self.far_dpt, near_dpt - self.far_dpt)

    def follow(self, distance_dpt: float, at_s: float) -> float:
        """Set the target distance from now on; return the current focus, dpt."""
        wanted_dpt = min(max(distance_dpt, self.far_dpt), self.near_dpt)
        return self.far_dpt + self._response.follow(wanted_dpt - self.far_dpt, at_s)
