"""How sharp kernels are that have several foci: as the nearest of them."""

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.survey import survey_pupils
from filter_service.planning.grid import GridSpec
from filter_service.planning.slopes import PupilStates, state_frames


def sharpest_blur_px(
    eye: EyeOptics, spec: GridSpec, states: PupilStates
) -> NDArray[np.float64]:
    """Geometric blur radius (P,), px, of the focus that is nearest in each state."""
    found_px = np.full(states.h_deg.size, np.inf)
    for wavelength_nm in np.unique(states.wavelength_nm).tolist():
        own = np.flatnonzero(states.wavelength_nm == wavelength_nm)
        for added_dpt in eye.rings.main_dpt(wavelength_nm).tolist():
            columns = vars(states.taken(own))
            columns["total_defocus_dpt"] = columns["total_defocus_dpt"] - added_dpt
            frames = state_frames(eye, spec, PupilStates(**columns))
            blur_px = survey_pupils(frames).blur_radius_px
            found_px[own] = np.minimum(found_px[own], blur_px)
    return found_px
