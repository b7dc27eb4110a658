"""Pupillary light reflex: the pupil diameter over time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

from estimator.dynamics.delayed_approach import DelayedApproach
from estimator.dynamics.pupil_size import steady_pupil_mm

LATENCY_AT_1_CD_M2_S = 0.270
LATENCY_PER_LOG_UNIT_S = 0.034
LATENCY_RANGE_S = (0.20, 0.36)
"""Latency falls by 34 ms per log unit of luminance (Myers & Stark 1993).  At 1 cd/m² it
is that of Link & Stark's formula for a step."""

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
