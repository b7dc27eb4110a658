"""Geometric blur of a plan's nodes, known before any of their PSFs is computed.

Where the layers of frames lie depends on it, so that it must not depend on which PSFs
there are.  Rays land in proportion to defocus: two defocus values of a group tell all.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.pupil import pupil_frames
from filter_service.constants import RGB
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.slopes import slopes_px
from filter_service.psfs.node_wavefronts import NodeWavefronts


def node_blur_px(
    eye: EyeOptics, spec: GridSpec, plan: CachePlan, wavefronts: NodeWavefronts
) -> NDArray[np.float32]:
    """Largest distance (n_psfs,), px, of rays from the chief ray, at PSFs' defocus.

    Rays are those of green light.  With several foci it is that of the nearest.
    """
    # Imported here: reading a plan must not load numba.
    from filter_service.psfs.blur_loops import fill_blur_px

    groups = np.arange(len(wavefronts.h_deg))
    green = np.full(groups.size, GREEN)
    zero_px, one_px = (
        slopes_px(
            pupil_frames(
                wavefront_polynomial(found.zernike_um),
                circle_radius_mm=found.circle_diameter_mm / 2.0,
                wavelength_nm=np.full(groups.size, wavefronts.wavelength_nm[GREEN, 0]),
                pixel_from_mrad=wavefronts.pixel_from_mrad,
                pupil_ellipse=found.pupil_ellipse,
            )
        )
        for found in (
            wavefronts.at(groups, green, np.full(groups.size, dpt), primaries=1)
            for dpt in (0.0, 1.0)
        )
    )
    foci_dpt = np.zeros((RGB, 1))
    if eye.rings is not None:
        own_dpt = [
            eye.rings.main_dpt(nm) for nm in spec.channel_wavelengths_nm.tolist()
        ]
        foci_dpt = np.full((RGB, max(map(len, own_dpt))), np.inf)
        for channel, found in enumerate(own_dpt):
            foci_dpt[channel, : len(found)] = found
    blur_px = np.empty(RGB * plan.defocus.values_dpt.size, np.float32)
    fill_blur_px(
        np.ascontiguousarray(zero_px),
        np.ascontiguousarray(one_px - zero_px),
        np.array(plan.defocus.values_dpt, np.float64),
        np.array(plan.defocus.starts, np.int64),
        np.array(plan.channel_shift_dpt, np.float64, order="C"),
        foci_dpt,
        blur_px,
    )
    return blur_px
