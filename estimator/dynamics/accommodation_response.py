"""How an eye's focus follows what it looks at, in time."""

from __future__ import annotations

from typing import Literal

from estimator.dynamics.delayed_approach import DelayedApproach

Cue = Literal["both", "blur"]

LATENCY_S = 0.36
"""Campbell & Westheimer 1960; from 18 to 49 years it does not change with age (Heron,
Charman & Gray 2002)."""

PEAK_SPEED_PER_DPT = {"both": 3.56, "blur": 7.10}
"""Main sequence, dpt/s of each dioptre: of accommodation that vergence drives, as both
eyes' does, and of one eye's by blur alone (ARVO 2007, article 2407307)."""

RELAXING_SPEED_PER_DPT, RELAXING_SPEED_DPT_S = 1.39, 1.12
"""Relaxation's peak speed follows from where it begins, whatever its size (Bharadwaj &
Schor 2006)."""

PLANT_S = 0.156
"""Time constant of lens and ciliary muscle alone (Schor & Bharadwaj 2006): nothing is
faster."""


def time_constant_s(begin_dpt: float, end_dpt: float, cue: Cue = "both") -> float:
    """Return the time constant of a step of accommodation, which is exponential.

    Its size over its peak speed.  Relaxing from near is faster, and small steps are as
    fast as lens and muscle are.

    Parameters
    ----------
    begin_dpt, end_dpt : float
        Accommodation, 0 where the eye is relaxed.
    cue : "both" or "blur"
        Both eyes, whose vergence leads, or blur alone.
    """
    if end_dpt >= begin_dpt:
        return max(PLANT_S, 1.0 / PEAK_SPEED_PER_DPT[cue])
    speed_dpt_s = RELAXING_SPEED_PER_DPT * max(begin_dpt, 0.0) + RELAXING_SPEED_DPT_S
    return max(PLANT_S, (begin_dpt - end_dpt) / speed_dpt_s)


class AccommodationResponse:
    """Follows the distance of what is looked at.

    In the steady state the eye is where it is wanted: acuity is best at or near that
    distance, whatever refractors say of a lag (Labhishetty, Cholewiak, Roorda & Banks,
    J. Vision 21(3):21, 2021).  Age decides how far an eye gets, and not how fast: the
    speed of steps hardly changes from 18 to 49 years (Heron, Charman & Gray, IOVS
    40:2872, 1999; Heron, Charman & Schor 2001).

    Parameters
    ----------
    far_dpt, near_dpt : float
        What the eye can focus on, with what the person wears; as of
        `Focusing.focus_limits_dpt`.
    cue : "both" or "blur"
        Both eyes, whose vergence leads, or blur alone.
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
        """Keep the eye between a far and a near point that it turns out to have."""
        self._response.hold(far_dpt - self.far_dpt, near_dpt - self.far_dpt)

    def follow(self, distance_dpt: float, at_s: float) -> float:
        """Look at something from now on; return where the eye is focused now, dpt."""
        wanted_dpt = min(max(distance_dpt, self.far_dpt), self.near_dpt)
        return self.far_dpt + self._response.follow(wanted_dpt - self.far_dpt, at_s)
