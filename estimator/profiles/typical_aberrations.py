"""Higher-order aberrations of eyes known by a prescription alone: typical or drawn.

A prescription does not determine coma, trefoil and spherical aberration, but every eye
has them.  An eye that is traced from a prescription gets the aberrations of a typical
person, or of a person drawn from the population if the profile has a ``sample``.

The mean *eye* would have hardly any coma or trefoil: their signs differ from one person
to the next and cancel in the mean.  A typical eye therefore has the root mean square of
each term, which makes its coma 1.2 times the mean coma of people (0.23 and 0.19 um).
Terms of azimuthal order 0 have their mean: with their root mean square, refraction
would change with the pupil more than it does in people.

Means and deviations by term come from 200 eyes (Thibos et al. 2002, JOSA A 19:2329;
Thibos, Bradley & Hong 2002, OPO 22:427), growth with age is from Berrio et al. 2010 (J
Vis 10(14):34).  `POOL_RATIO` scales them to the RMS of 2,560 eyes (Salmon & van de Pol
2006, JCRS 32:2064), 0.045, 0.100, 0.186 and 0.327 um at 3, 4, 5 and 6 mm: a typical
young eye and the mean of drawn ones differ by at most 4 %.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from estimator.note import Note
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
    (4, -4): (-0.017, 0.034),
    (4, -2): (0.009, 0.029),
    (4, 0): (0.094, 0.098),
    (4, 2): (-0.010, 0.050),
    (4, 4): (-0.011, 0.046),
    (5, -5): (-0.004, 0.023),
    (5, -3): (0.007, 0.023),
    (5, -1): (-0.010, 0.025),
    (5, 1): (0.002, 0.020),
    (5, 3): (-0.002, 0.015),
    (5, 5): (-0.002, 0.023),
    (6, -6): (0.000, 0.012),
    (6, -4): (-0.001, 0.008),
    (6, -2): (0.001, 0.007),
    (6, 0): (-0.001, 0.019),
    (6, 2): (0.001, 0.014),
    (6, 4): (0.009, 0.013),
    (6, 6): (-0.001, 0.013),
}
"""Mean and standard deviation by (n, m) at 6 mm, examiner's frame, of 200 eyes of young
adults (Thibos et al. 2002).  Thibos, Bradley & Hong 2002 draw eyes from a normal
distribution of them."""

POOL_RATIO = 1.15
"""RMS of Salmon & van de Pol's eyes over the RMS of Thibos et al., at 3 to 6 mm; it
applies to all terms except a typical C(4,0), whose mean is the same in both."""

TYPICAL_SIGNS = {
    (3, 1): 1.0,
    (5, -3): 1.0,
    (5, -1): -1.0,
    (5, 1): -1.0,
    (5, 3): 1.0,
    (6, -4): -1.0,
    (6, -2): 1.0,
    (6, 2): -1.0,
    (6, 4): -1.0,
}
"""Signs of typical terms, whose means are close to 0; others have their mean's sign.
The signs are chosen such that smaller pupils, in which the fifth and sixth order appear
as lower ones, have the RMS and the MTF of people: the MTF of a typical eye from 2 to 30
c/deg differs by -0.01, +0.01, 0.00 and -0.03 at 3, 4, 5 and 6 mm from the mean MTF of
the 200 eyes, without `POOL_RATIO`."""

SAME_AZIMUTH_CORRELATION = {(3, 5): -0.2, (4, 6): -0.4}
"""Correlation of terms of two orders with the same azimuthal order, which is not 0, in
the eyes of Thibos et al.  Without it, the RMS of drawn persons is 10 % too low at 3
mm."""

FREEDOM = 4
"""Degrees of freedom of the chi-square distribution of a drawn person's variance over
its mean (a generalized Laplace distribution: Kotz, Kozubowski & Podgorski 2001).  The
RMS has a standard deviation of 43 to 48 % of its mean in people (Thibos et al.) and in
drawn persons; in a normal distribution it would be 30 %.  At 6 mm, the largest of 1,000
has 3.2 times the mean RMS.  In a t-distribution with 7 degrees of freedom it has 3.9
times, and the RMS of the eyes of Jaeken & Artal (IOVS 53(7), 2012; 129, on the axis, 4
mm) is less likely by 3.3 nat."""

LARGEST_RMS_UM = 1.05
"""Largest RMS of a drawn person at `TYPICAL_PUPIL_MM`, before growth with age; others
are drawn again.  It is the mean of 46 eyes that were suspected of keratoconus, beside
0.30 um (deviation 0.11 um) of 65 normal eyes (ARVO abstract,
iovs.arvojournals.org/article.aspx?articleid=2372593).  Of the eyes of Jaeken & Artal
the largest has 3.0 times the mean RMS; this is 3.2 times."""

GROWTH_UM_PER_YEAR = {(3, 1): 0.0017, (4, 0): 0.0011}
"""Growth through `GROWTH_PUPIL_MM`, between 20 and 77 years (Berrio et al. 2010).
Atchison & Markwell 2008 also found horizontal coma to change with age.  At 6 mm the RMS
then grows by 0.003 um a year, as in Seo et al. 2025 (J Clin Med 14:6981)."""

GROWTH_PUPIL_MM = 5.0
AGES_YEARS = (20.0, 77.0)
"""Ages for which growth is known; other ages are clamped to this range."""

YOUNG_ADULT_YEARS = 25.0
"""Age of `POPULATION_UM`, and of an eye whose age is not known."""


AXIS_STREAM = 0
"""Second seed of the random on-axis aberrations; `periphery.change` has another."""


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
    growth_um = _growth_um(age_years)
    zernike_um = np.zeros(N_TERMS)
    for (n, m), (mean_um, deviation_um) in POPULATION_UM.items():
        j = index_from_nm(n, m)
        if m == 0:
            zernike_um[j] = mean_um + growth_um[j]
            continue
        size_um = POOL_RATIO * math.hypot(mean_um, deviation_um) + growth_um[j]
        sign = TYPICAL_SIGNS.get((n, m), math.copysign(1.0, mean_um))
        zernike_um[j] = sign * size_um
    return _in_eye_frame(zernike_um, eye_side)


def drawn_zernike_um(
    sample: int, age_years: float | None, *, eye_side: str
) -> NDArray[np.float64]:
    """Return higher-order coefficients (28,), um, of a person, in the eye frame.

    Parameters
    ----------
    sample : int
        Seed from 0 to 999,999; each is a person.
    age_years, eye_side
        As in `typical_zernike_um`.
    """
    # The stream of `RandomState` is the same in all versions of NumPy.
    random = np.random.RandomState([sample, AXIS_STREAM])
    mean_um, root_um = _population_um()
    zernike_um = np.full(N_TERMS, np.inf)
    while np.linalg.norm(zernike_um) > LARGEST_RMS_UM:
        size = math.sqrt(random.chisquare(FREEDOM) / FREEDOM)
        zernike_um = np.zeros(N_TERMS)
        zernike_um[list(mean_um)] = POOL_RATIO * (
            np.array(list(mean_um.values()))
            + size * root_um @ random.standard_normal(len(mean_um))
        )
    return _in_eye_frame(zernike_um + _growth_um(age_years), eye_side)


@cache
def _population_um() -> tuple[dict[int, float], NDArray[np.float64]]:
    """Return means by OSA index, and a root (n, n) of the covariance of these terms."""
    terms = list(POPULATION_UM)
    correlation = np.eye(len(terms))
    for (low, high), value in SAME_AZIMUTH_CORRELATION.items():
        for k, (n, m) in enumerate(terms):
            if n == low and m != 0:
                other = terms.index((high, m))
                correlation[k, other] = correlation[other, k] = value
    deviation_um = np.array([deviation for _, deviation in POPULATION_UM.values()])
    mean_um = {index_from_nm(*nm): mean for nm, (mean, _) in POPULATION_UM.items()}
    return mean_um, deviation_um[:, None] * np.linalg.cholesky(correlation)


def _growth_um(age_years: float | None) -> NDArray[np.float64]:
    """Return the growth (28,) since `YOUNG_ADULT_YEARS` at `TYPICAL_PUPIL_MM`."""
    years = used_age_years(age_years) - YOUNG_ADULT_YEARS
    growth_um = np.zeros(N_TERMS)
    for (n, m), yearly_um in GROWTH_UM_PER_YEAR.items():
        widening = (TYPICAL_PUPIL_MM / GROWTH_PUPIL_MM) ** n
        growth_um[index_from_nm(n, m)] = years * widening * yearly_um
    return growth_um


def _in_eye_frame(
    zernike_um: NDArray[np.float64], eye_side: str
) -> NDArray[np.float64]:
    """Convert coefficients of a right eye from the examiner's to the eye's frame."""
    return flip_horizontal(zernike_um) if eye_side == "OD" else zernike_um


def used_age_years(age_years: float | None) -> float:
    """Return the age clamped to the known range; a young adult's if None."""
    if age_years is None:
        return YOUNG_ADULT_YEARS
    return min(max(age_years, AGES_YEARS[0]), AGES_YEARS[1])


def _higher_um(profile: EyeProfile) -> NDArray[np.float64]:
    if profile.sample is None:
        return typical_zernike_um(profile.age_years, eye_side=profile.eye_side)
    return drawn_zernike_um(
        profile.sample, profile.age_years, eye_side=profile.eye_side
    )


def with_typical_aberrations(profile: EyeProfile) -> EyeProfile:
    """Return the profile with typical or drawn aberrations added if it requests them.

    The result requests none.  Its second order is chosen so that its least-squares
    refraction through `PRESCRIBED_PUPIL_MM` equals the profile, which is exactly
    second order.
    """
    if profile.higher_order != "typical":
        return profile
    higher_um = _higher_um(profile)
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
    """Return a note on the terms that `with_typical_aberrations` adds to a profile."""
    whose = "a young adult"
    if profile.age_years is not None:
        whose = f"{used_age_years(profile.age_years):g} years of age"
    source = f"typical of {whose}"
    if profile.sample is not None:
        source = f"of a person drawn with sample {profile.sample} for {whose}"
    rms_um = float(np.linalg.norm(_higher_um(profile)))
    return Note(
        "typical_aberrations",
        f"higher-order aberrations {source} added to the prescription, RMS "
        f"{rms_um:.2f} um at {TYPICAL_PUPIL_MM:g} mm; "
        f'"higher_order": "none" in the profile switches them off',
        rms_um=rms_um,
        pupil_diameter_mm=TYPICAL_PUPIL_MM,
    )


PEOPLE_LIMITS = (2, 1000)
"""Allowed numbers of persons."""


def draws_axis(profile: EyeProfile) -> bool:
    """Return whether drawn persons differ in higher orders on the axis."""
    return profile.kind == "prescription" and profile.higher_order == "typical"


def draws_periphery(profile: EyeProfile) -> bool:
    """Return whether drawn persons differ in the periphery."""
    return not profile.is_given and profile.periphery == "people"


def draws_eye(profile: EyeProfile) -> bool:
    """Return whether drawn persons differ in the whole eye, with its refraction."""
    return profile.kind == "synteyes"


def drawn_text(profile: EyeProfile) -> str:
    """Describe the quantities that drawn persons share, and those that differ."""
    if draws_eye(profile):
        return "the whole eye, with its refraction, drawn from SyntEyes"
    drawn = []
    if draws_axis(profile):
        drawn.append("the higher orders on the axis")
    if draws_periphery(profile):
        drawn.append("the periphery")
    common = "the prescription"
    if profile.kind != "prescription":
        count = len(profile.measurements)
        common = "the measurement on the axis" if count == 1 else "the measurements"
    return f"{' and '.join(drawn)} drawn from the population; {common} unchanged"


def drawn_profiles(profile: EyeProfile, count: int) -> list[EyeProfile]:
    """Return the profiles of persons drawn from the population: samples 0, 1, 2 ...

    Parameters
    ----------
    profile : EyeProfile
        Its own ``sample`` is replaced.
    count : int
        Number of persons, 2 to 1000.

    Raises
    ------
    ValueError
        The count is not allowed, or persons with this profile do not differ.
    """
    low, high = PEOPLE_LIMITS
    if not low <= count <= high:
        raise ValueError(f"people is {count}; allowed: {low} to {high}")
    if draws_eye(profile):
        from estimator.profiles.synteyes import with_drawn_eye  # loads slowly

        return [with_drawn_eye(profile, k) for k in range(count)]
    if not (draws_axis(profile) or draws_periphery(profile)):
        raise ValueError(
            f"people: nothing to draw, because {_reason(profile)}; expected a "
            "prescription, a measured wavefront with 'periphery' people, or kind "
            "'synteyes'"
        )
    return [replace(profile, sample=k) for k in range(count)]


def _reason(profile: EyeProfile) -> str:
    if profile.is_given:
        return "the profile gives the eye itself"
    known = "the wavefront on the axis is measured"
    if profile.kind == "prescription":
        known = "'higher_order' is none"
    return f"{known} and 'periphery' is model"
