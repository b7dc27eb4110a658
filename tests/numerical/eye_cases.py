"""Wavefronts to estimate eyes from: the conditions, random eyes, a population."""

import numpy as np

from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import zernike_of_vectors
from estimator.optics.prescription import zernike_from_power_vector
from estimator.optics.zernike import N_TERMS, nm_from_index
from estimator.profiles.parse import EyeProfile, Measurement

POPULATION_UM = {
    # pupil, mm: {index: (mean, standard deviation)}, um (Thibos 2002)
    4.5: {
        **{6: (-0.017, 0.059), 7: (-0.004, 0.075), 8: (0.0, 0.052), 9: (0.0, 0.044)},
        12: (0.030, 0.034),
    },
    6.0: {
        **{6: (-0.021, 0.115), 7: (-0.032, 0.168), 8: (0.002, 0.105)},
        **{9: (-0.003, 0.094), 12: (0.094, 0.098)},
    },
}
OTHER_DEVIATION_UM = {
    # pupil, mm: {order: deviation of the terms not in the table}; about a third of the
    # order's own terms, falling threefold per order as population studies find
    4.5: {4: 0.012, 5: 0.006, 6: 0.003},
    6.0: {4: 0.035, 5: 0.018, 6: 0.010},
}
REFRACTIONS_DPT = (-8.0, 4.0)
ASTIGMATISM_DEVIATION_DPT = 0.4


def as_profile(zernike_um, *, pupil_diameter_mm, wavelength_nm, name):
    """A measured profile of one set of coefficients."""
    measurement = Measurement(zernike_um, pupil_diameter_mm, wavelength_nm)
    return EyeProfile(
        name=name,
        kind="zernike",
        eye_side="OD",
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        max_pupil_diameter_mm=pupil_diameter_mm,
        measurements=(measurement,),
    )


def random_eye_profiles(count, rng):
    """Profiles traced through eyes from the paper's ranges; (profile, vector).

    Pupils and wavelengths are drawn from its ranges too; eyes that light does not
    cross are drawn again.
    """
    found = []
    while len(found) < count:
        vector = random_vectors(1, rng)[0]
        pupil_mm = float(rng.uniform(3.0, 6.0))
        wavelength_nm = float(rng.uniform(450.0, 900.0))
        zernike_um = zernike_of_vectors(
            vector[None], pupil_diameter_mm=pupil_mm, wavelength_nm=wavelength_nm
        )[0]
        if np.all(np.isfinite(zernike_um)):
            profile = as_profile(
                zernike_um,
                pupil_diameter_mm=pupil_mm,
                wavelength_nm=wavelength_nm,
                name="random eye",
            )
            found.append((profile, vector))
    return found


def population_profiles(count, rng):
    """Wavefronts drawn from population statistics, with a refraction; no model."""
    profiles = []
    for number in range(count):
        pupil_mm = (4.5, 6.0)[number % 2]
        zernike_um = zernike_from_power_vector(
            rng.uniform(*REFRACTIONS_DPT),
            *rng.normal(0.0, ASTIGMATISM_DEVIATION_DPT, 2),
            zernike_radius_mm=pupil_mm / 2.0,
        )
        for j in range(6, N_TERMS):
            order = nm_from_index(j)[0]
            other = OTHER_DEVIATION_UM[pupil_mm].get(order, 0.0)
            mean, deviation = POPULATION_UM[pupil_mm].get(j, (0.0, other))
            zernike_um[j] += rng.normal(mean, deviation)
        profiles.append(
            as_profile(
                zernike_um,
                pupil_diameter_mm=pupil_mm,
                wavelength_nm=555.0,
                name="population",
            )
        )
    return profiles
