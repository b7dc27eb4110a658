"""Response of the pupil to light over time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

from estimator.dynamics.delayed_approach import DelayedApproach
from estimator.dynamics.pupil_size import steady_pupil_mm

LATENCY_AT_1_CD_M2_S = 0.270
LATENCY_PER_LOG_UNIT_S = 0.034
LATENCY_RANGE_S = (0.20, 0.36)
"""Latency falls by 34 ms for each log unit of light (Myers & Stark 1993); at 1 cd/m² it
is that of Link & Stark's formula for a single step."""

FAST_SHARE = 0.4
CONSTRICTING_S = (0.28, 0.28)
DILATING_S = (0.9, 2.9)
"""Time constants of the fast and the slow part: redilation has both.  They are fitted,
to 0.14 mm, to pulses of 1 s at five powers of light (recorded by Martin, Pinto, Bulte &
Spitschan, 2021)."""


def reflex_latency_s(luminance_cd_m2: float) -> float:
    """Return the latency of the pupil at a luminance."""
    log_light = math.log10(max(luminance_cd_m2, 1e-9))
    latency_s = LATENCY_AT_1_CD_M2_S - LATENCY_PER_LOG_UNIT_S * log_light
    return min(max(latency_s, LATENCY_RANGE_S[0]), LATENCY_RANGE_S[1])


class PupilReflex:
    """Pupil that follows the luminance of the scene.

    Parameters
    ----------
    age_years, field_area_deg2, n_eyes
        Parameters of `steady_pupil_mm`, which the pupil approaches.
    luminance_cd_m2 : float
        Initial luminance, at which the pupil is steady.
    latency_s : float, optional
        Measured latency of this person; `reflex_latency_s` by default.
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
        self._how = field_area_deg2, age_years, n_eyes
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
        field_area_deg2, age_years, n_eyes = self._how
        return steady_pupil_mm(
            luminance_cd_m2, field_area_deg2, age_years, n_eyes=n_eyes
        )

    def follow(self, luminance_cd_m2: float, at_s: float) -> float:
        """Set the luminance from now on; return the current pupil diameter, mm."""
        target_mm = self._steady_mm(luminance_cd_m2)
        latency_s = self._latency_s
        if latency_s is None:
            latency_s = reflex_latency_s(luminance_cd_m2)
        fast_mm, slow_mm = (
            part.follow(target_mm, at_s, latency_s) for part in self._parts
        )
        return FAST_SHARE * fast_mm + (1.0 - FAST_SHARE) * slow_mm
