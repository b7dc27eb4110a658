"""Published measurements of human eyes, as closed formulas and tables."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.acuity.transfer import perfect_transfer

NAVARRO_PUPIL_MM, NAVARRO_NM, NAVARRO_FOCUS_DPT = 4.0, 632.8, 3.0
"""Conditions of Navarro, Artal & Williams 1993."""

NAVARRO = {
    # eccentricity, deg: A and B, deg; C
    0: (0.172, 0.037, 0.22),
    5: (0.245, 0.041, 0.20),
    10: (0.245, 0.041, 0.20),
    20: (0.328, 0.038, 0.14),
    30: (0.606, 0.064, 0.12),
    40: (0.82, 0.064, 0.09),
}
"""Coefficients of `navarro_modulation` up to 40 deg."""

WILLIAMS_PUPIL_MM, WILLIAMS_NM = 3.0, 632.8
WILLIAMS = (0.3481, 0.6519, 0.1212)

SALMON_RMS_UM = {3.0: 0.045, 4.0: 0.100, 5.0: 0.186, 6.0: 0.327}
"""Mean RMS of orders 3 to 6 by pupil diameter, mm: 2560 eyes of 1433 adults (Salmon &
van de Pol, J Cataract Refract Surg 32:2064, 2006)."""

SALMON_TWICE_RATIO = 0.9
"""Proportion of these eyes, at least, with less than twice the mean."""

SMITH_ARCMIN = 0.65
"""For each mm of pupil and dpt of defocus (Smith, Optom Vis Sci 68:491, 1991; the
constant as later papers cite it)."""

YOUNG_LOG_MAR = -0.13
"""Best corrected, natural pupils, 18 to 24 years; -0.16 at 25 to 29 (Elliott, Yang &
Whitaker, Optom Vis Sci 72:186, 1995: 223 healthy eyes, charts of letters).

The same is expected through 2 to 6 mm.  In 22 corrected young eyes, at 120 cd/m²,
acuity was best through artificial pupils of 2 to 3 mm and hardly worse through wider
ones (Atchison, Smith & Efron, Am J Optom Physiol Opt 56:315, 1979).  49 eyes of 22 to
63 years, chosen for at least 20/17, read 20/15 (-0.12) through 7 mm or more at 270
cd/m² (Applegate, Marsack & Thibos, Optom Vis Sci 83:635, 2006)."""

UNAIDED_PUPILS_MM = (2.3, 7.5)
"""Natural pupils of `unaided_log_mar`."""

STILES_CRAWFORD_LOG_MAR = {4.0: 0.06, 6.0: 0.16}
"""Largest loss of acuity within 2 dpt of defocus, by pupil, when a filter cancels the
Stiles-Crawford effect: 4 eyes (Atchison, Scott, Strang & Artal, JOSA A 19:1073,
2002)."""

DRIVERS_LOG_S = {7.0: 0.87, 10.0: 0.90}
"""Straylight parameter log s of the young by angle, deg: 2422 European drivers (van den
Berg et al., Am J Ophthalmol 144:358, 2007).  Its standard deviation is 0.10."""

CATARACT_LOG_S = {"nuclear": 1.22, "cortical": 1.26, "posterior_subcapsular": 1.48}
"""Mean log s before surgery (J Ophthalmol 2017, 5649532), with standard deviations of
0.20, 0.23 and 0.34."""

NEAR_PERIPHERY_RATIO = {
    "Calver 2007, Davies & Mallen 2009": 0.0,
    "Whatham 2009, Lundstrom 2009": -0.3 / 4.0,
}
"""Change of M at +-30 deg, relative to the fovea, for each dpt of accommodation.

Calver et al. (Ophthalmic Physiol Opt 27:584) compared targets at 2.5 and 0.4 m, Davies
& Mallen (Br J Ophthalmol 93, 2009) targets up to 3 dpt; neither found an effect.
Whatham et al. (J Vis 9(3):14) and Lundstrom et al. (J Vis 9(6):17) found 0.1 to 0.5 dpt
more myopia over several dpt; -0.3 over 4 dpt is the middle of that."""

MATHUR_FOCUS_DPT, MATHUR_PUPIL_MM, MATHUR_C40_UM = (0.3, 4.0), 5.0, -0.10
"""Change of C(4,0) in all of 38 directions within 21 deg: 9 young adult emmetropes
(Mathur, Atchison & Charman, J Vis 9(12):20, 2009).  Relative refraction, astigmatism
and other higher orders hardly changed."""

LOPEZ_GIL_RATIO = 1.0 / 7.0
"""Accommodation response, dpt, that the change of spherical aberration takes from each
dpt of stimulus, if the eye minimizes the RMS: 15 eyes with natural pupils
(López-Gil & Fernández-Sánchez, J Vis 10(13):12, 2010).

Studies that agree in the sign, without a slope in their abstracts:

- He, Burns & Marcos, Vision Res 40:41, 2000 (8 eyes, 0 to 6 dpt): C(4,0) falls in every
  eye, but does not become negative in every eye.
- Cheng et al., J Vis 4(4):3, 2004 (76 eyes).
- Plainis, Ginis & Pallikaris, J Vis 5(5):7, 2005 (7 eyes, up to 8 dpt).
- Radhakrishnan & Charman, J Vis 7(7):11, 2007 (47 eyes, 17 to 56 years, 0 to 4 dpt):
  C(4,0) falls and becomes negative below 40 years.
- Zhou et al., Eye 29:115, 2015 (22 eyes, 18 to 28 years, 0 to 6 dpt): C(4,0) falls at
  responses of 0.85, 1.63, 2.38, 3.25, 4.18 and 5.09 dpt.

Atchison et al., Vision Res 35:313, 1995, found a fall in 8 of 15 eyes up to 3 dpt."""


def mathur_slope_um(pupil_diameter_mm: ArrayLike) -> NDArray[np.float64]:
    """Return the change of C(4,0) (...), um for each dpt, scaled to other pupils."""
    far_dpt, near_dpt = MATHUR_FOCUS_DPT
    ratio = np.asarray(pupil_diameter_mm, dtype=np.float64) / MATHUR_PUPIL_MM
    slope_um: NDArray[np.float64] = MATHUR_C40_UM / (near_dpt - far_dpt) * ratio**4
    return slope_um


def taken_ratio(
    slope_um: ArrayLike, pupil_diameter_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return what `LOPEZ_GIL_RATIO` is for a slope (...) of C(4,0), um for each dpt.

    The refraction with the smallest RMS and that of the center differ by
    12 sqrt(5) C(4,0) / r².
    """
    radius_mm = 0.5 * np.asarray(pupil_diameter_mm, dtype=np.float64)
    ratio: NDArray[np.float64] = (
        -12.0 * np.sqrt(5.0) * np.asarray(slope_um) / radius_mm**2
    )
    return ratio


def navarro_modulation(
    frequency_cpd: ArrayLike, eccentricity_deg: int
) -> NDArray[np.float64]:
    """Return the double-pass modulation transfer (...) at an angle of `NAVARRO`.

    References
    ----------
    Navarro, Artal & Williams, JOSA A 10:201, 1993.
    """
    fast_deg, slow_deg, slow_part = NAVARRO[eccentricity_deg]
    cpd = np.asarray(frequency_cpd, dtype=np.float64)
    fast, slow = np.exp(-fast_deg * cpd), np.exp(-slow_deg * cpd)
    modulation: NDArray[np.float64] = (1.0 - slow_part) * fast + slow_part * slow
    return modulation


def williams_modulation(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the modulation transfer (...) of the fovea through 3 mm.

    References
    ----------
    Williams, Brainard, McMahon & Navarro, JOSA A 11:3123, 1994.
    """
    constant, decaying, decay_deg = WILLIAMS
    cpd = np.asarray(frequency_cpd, dtype=np.float64)
    perfect = perfect_transfer(
        cpd, pupil_diameter_mm=WILLIAMS_PUPIL_MM, wavelength_nm=WILLIAMS_NM
    )
    return perfect * (constant + decaying * np.exp(-decay_deg * cpd))


def smith_log_mar(pupil_diameter_mm: float, defocus_dpt: ArrayLike) -> NDArray:
    """Return the acuity (...), logMAR, of defocused eyes by Smith's law."""
    return np.log10(SMITH_ARCMIN * pupil_diameter_mm * np.asarray(defocus_dpt))


def blendowske_lost_log_mar(defocus_dpt: ArrayLike) -> NDArray[np.float64]:
    """Return what defocus (...) costs, logMAR, with natural pupils of 2 to 5 mm.

    References
    ----------
    Blendowske, Optom Vis Sci 92:e121, 2015: seven sets of data, adjusted R² 0.99.
    """
    lost: NDArray[np.float64] = np.log10(1.0 + np.square(defocus_dpt))
    return lost


def unaided_log_mar(pupil_diameter_mm: float, defocus_dpt: ArrayLike) -> NDArray:
    """Return the acuity (...), logMAR, of uncorrected myopes, by their natural pupil.

    References
    ----------
    "The influence on unaided vision of age, pupil diameter and sphero-cylindrical
    refractive error", Clin Exp Optom 99:328, 2016 (doi 10.1111/cxo.12344): right eyes
    of 663 persons of 20 to 70 years, -0.3 to 1.3 logMAR; the regression of the myopes
    accounts for 81 % of the variance.
    """
    return np.log10(2.91 * np.asarray(defocus_dpt) + 0.51 * pupil_diameter_mm - 3.14)


def published_log_mar(pupil_diameter_mm: float, defocus_dpt: float) -> dict[str, float]:
    """Return the acuity, logMAR, by source, of young adults out of focus.

    Defocus is myopic and counts from the best correction.  Each source is used where
    it is valid: Smith's law and the regression from 1 dpt on, where blur limits acuity,
    the regression through pupils of its people, and Blendowske's law through natural
    pupils of 3 and 4 mm.  Where no source is valid, the result is empty.
    """
    if defocus_dpt == 0.0:
        return {"Elliott 1995": YOUNG_LOG_MAR}
    found = {}
    if defocus_dpt >= 1.0:
        found["Smith 1991"] = float(smith_log_mar(pupil_diameter_mm, defocus_dpt))
        if UNAIDED_PUPILS_MM[0] <= pupil_diameter_mm <= UNAIDED_PUPILS_MM[1]:
            unaided = unaided_log_mar(pupil_diameter_mm, defocus_dpt)
            found["663 eyes, 2016"] = float(unaided)
    if pupil_diameter_mm in (3.0, 4.0):
        lost = float(blendowske_lost_log_mar(defocus_dpt))
        found["Blendowske 2015"] = YOUNG_LOG_MAR + lost
    return found


def drivers_log_s(angle_deg: float, age_years: ArrayLike) -> NDArray[np.float64]:
    """Return the straylight parameter log s (...) of healthy eyes by age.

    Parameters
    ----------
    angle_deg : {7, 10}
    age_years : (...)
    """
    growth = 1.0 + (np.asarray(age_years, dtype=np.float64) / 65.0) ** 4
    log_s: NDArray[np.float64] = DRIVERS_LOG_S[angle_deg] + np.log10(growth)
    return log_s


ROZEMA_PUPIL_MM = 5.0
ROZEMA_EYES = 330
ROZEMA_M_DPT = (-0.854, 2.42)
ROZEMA_M_SKEWNESS = -0.72
ROZEMA_UM = {
    (3, -3): (-0.061, 0.111),
    (3, -1): (-0.010, 0.139),
    (3, 1): (-0.058, 0.118),
    (3, 3): (0.004, 0.088),
    (4, -4): (0.009, 0.038),
    (4, -2): (0.002, 0.036),
    (4, 0): (0.073, 0.080),
    (4, 2): (0.006, 0.048),
    (4, 4): (0.008, 0.049),
}
"""Mean and standard deviation of the spherical equivalent M, and of terms by (n, m) in
the examiner's frame, of the wavefronts of 330 healthy right eyes, some of which are the
eyes of SyntEyes (Rozema et al., Optom Vis Sci 94:680, 2017).  They are moments of the
statistical model of these wavefronts, which https://github.com/neesingh/IRIS
distributes as includes/eye_models/WF_Model_Data.mat."""
