"""Typical higher-order aberrations for eyes known by a prescription alone.

A prescription does not determine coma, trefoil and spherical aberration, but every eye
has them.  An eye that is traced from a prescription gets those of a typical person: the
mean C(4,0), and the mean absolute size of coma and trefoil.  The mean *eye* would have
hardly any coma or trefoil: their signs differ from one person to the next and cancel in
the mean.  Their direction is that of the population mean.

Sizes are from Thibos et al. 2002 (JOSA A 19:2329), growth with age from Berrio et al.
2010 (J Vis 10(14):34).  The terms that these do not give (fifth and sixth order, and
the fourth except C(4,0)) are zero, so the RMS of 0.22 um in a young eye and 0.26 um at
41 is somewhat below measurements that include them: 0.305 +- 0.095 um (Wang & Koch
2003, at 41 years on average), 0.33 um (Salmon & van de Pol 2006).
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.optics.prescription import C2M2, C20, C22
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    index_from_nm,
    rescale_pupil,
)
from estimator.profiles.parse import EyeProfile, Measurement

TYPICAL_PUPIL_MM = 6.0
"""Diameter of the circle on which typical aberrations are given."""

PRESCRIBED_PUPIL_MM = 4.0
"""Pupil through which the refraction is the prescription, as in a lit test room."""

POPULATION_UM = {
    (3, -3): (-0.021, 0.115),
    (3, -1): (-0.032, 0.168),
    (3, 1): (0.002, 0.105),
    (3, 3): (-0.003, 0.094),
    (4, 0): (0.094, 0.098),
}
"""Mean and standard deviation by (n, m) at 6 mm, examiner's frame, of 200 eyes of young
adults (Thibos et al. 2002).  Thibos, Bradley & Hong 2002 draw eyes from this normal
distribution."""

GROWTH_UM_PER_YEAR = {(3, 1): 0.0017, (4, 0): 0.0011}
"""Growth through `GROWTH_PUPIL_MM`, between 20 and 77 years (Berrio et al. 2010).
Atchison & Markwell 2008 also found horizontal coma to change with age.  At 6 mm the RMS
then grows by 0.003 um a year, as in Seo et al. 2025 (J Clin Med 14:6981)."""

GROWTH_PUPIL_MM = 5.0
AGES_YEARS = (20.0, 77.0)
"""Ages for which growth is known; other ages are clamped to this range."""

YOUNG_ADULT_YEARS = 25.0
"""Age of `POPULATION_UM`, and of an eye whose age is not known."""


def typical_zernike_um(
    age_years: float | None, *, eye_side: str
) -> NDArray[np.float64]:
    """Return higher-order coefficients (28,), um, of a typical eye, in the eye frame.

    They are on the circle of `TYPICAL_PUPIL_MM`, at 555 nm (they hardly change with
    color).

    Parameters
    ----------
    age_years : float or None
        Age; None is a young adult.
    eye_side : {"OD", "OS"}
        Side; the figures are used for right eyes, and left eyes mirror them.
    """
    years = used_age_years(age_years) - YOUNG_ADULT_YEARS
    zernike_um = np.zeros(N_TERMS)
    for (n, m), (mean_um, deviation_um) in POPULATION_UM.items():
        size_um = mean_um
        if n == 3:
            size_um = mean_absolute_um(mean_um, deviation_um)
        widening = (TYPICAL_PUPIL_MM / GROWTH_PUPIL_MM) ** n
        size_um += years * widening * GROWTH_UM_PER_YEAR.get((n, m), 0.0)
        zernike_um[index_from_nm(n, m)] = math.copysign(size_um, mean_um)
    return flip_horizontal(zernike_um) if eye_side == "OD" else zernike_um


def used_age_years(age_years: float | None) -> float:
    """Return the age clamped to the known range; a young adult's if None."""
    if age_years is None:
        return YOUNG_ADULT_YEARS
    return min(max(age_years, AGES_YEARS[0]), AGES_YEARS[1])


def mean_absolute_um(mean_um: float, deviation_um: float) -> float:
    """Return the mean absolute value of a normally distributed coefficient."""
    ratio = mean_um / (math.sqrt(2.0) * deviation_um)
    spread_um = deviation_um * math.sqrt(2.0 / math.pi) * math.exp(-(ratio**2))
    return spread_um + mean_um * math.erf(ratio)


def with_typical_aberrations(profile: EyeProfile) -> EyeProfile:
    """Return the profile with typical aberrations added if it requests them.

    The result requests none.  Its second order is chosen so that its least-squares
    refraction through `PRESCRIBED_PUPIL_MM` is that of the profile, which is exactly
    second order.
    """
    if profile.higher_order != "typical":
        return profile
    higher_um = typical_zernike_um(profile.age_years, eye_side=profile.eye_side)
    ratio = PRESCRIBED_PUPIL_MM / TYPICAL_PUPIL_MM
    second = [C2M2, C20, C22]
    seen_um = rescale_pupil(higher_um, radius_ratio=ratio)[second] / ratio**2
    on_circle = TYPICAL_PUPIL_MM / profile.pupil_diameter_mm
    zernike_um = rescale_pupil(profile.zernike_um, radius_ratio=on_circle) + higher_um
    zernike_um[second] -= seen_um
    measurement = Measurement(zernike_um, TYPICAL_PUPIL_MM, REFERENCE_WAVELENGTH_NM)
    return replace(
        profile,
        pupil_diameter_mm=measurement.pupil_diameter_mm,
        wavelength_nm=measurement.wavelength_nm,
        measurements=(measurement,),
        higher_order="none",
    )


def typical_note(profile: EyeProfile) -> str:
    """Return a note on what `with_typical_aberrations` adds to a profile."""
    whose = "a young adult"
    if profile.age_years is not None:
        whose = f"{used_age_years(profile.age_years):g} years of age"
    added_um = typical_zernike_um(profile.age_years, eye_side=profile.eye_side)
    rms_um = float(np.linalg.norm(added_um))
    return (
        f"higher-order aberrations typical of {whose} added to the prescription, RMS "
        f"{rms_um:.2f} um at {TYPICAL_PUPIL_MM:g} mm; "
        f'"higher_order": "none" in the profile switches them off'
    )
