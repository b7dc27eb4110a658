"""Steady-state pupil diameter."""

from __future__ import annotations

import math

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
