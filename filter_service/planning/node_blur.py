"""Geometric blur of a plan's nodes, computed without their PSFs.

The layers of frames depend on this blur, so it must not depend on which PSFs have been
computed.  Landing points of rays are linear in defocus, so two values of defocus
suffice for each group.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.pupil import pupil_frames
from filter_service.constants import RGB
from filter_service.native import loops
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.node_wavefronts import NodeWavefronts
from filter_service.planning.nodes import RaggedNodes
from filter_service.planning.slopes import slopes_px


class GroupRays(NamedTuple):
    """Landing points of each group's green rays at 0 dpt, and their shift per diopter.

    Attributes
    ----------
    zero_px, per_dpt : (n_groups, n_rays, 2)
        In px.
    """

    zero_px: NDArray[np.float64]
    per_dpt: NDArray[np.float64]

    @classmethod
    def of(cls, wavefronts: NodeWavefronts) -> "GroupRays":
        """Trace rays through wavefronts, averaged over the wavelengths of a primary."""
        zero_um = wavefronts.zernike_um[:, GREEN].mean(axis=1)
        per_dpt_um = wavefronts.per_dpt_um[:, GREEN].mean(axis=1)
        both = (2, 1)
        slopes = slopes_px(
            pupil_frames(
                wavefront_polynomial(np.concatenate([zero_um, zero_um + per_dpt_um])),
                circle_radius_mm=np.tile(
                    wavefronts.circle_diameter_mm[:, GREEN, 0] / 2.0, 2
                ),
                wavelength_nm=np.full(
                    2 * len(zero_um), wavefronts.wavelength_nm[GREEN].mean()
                ),
                pixel_from_mrad=np.tile(wavefronts.pixel_from_mrad, (*both, 1)),
                pupil_ellipse=np.tile(wavefronts.pupil_ellipse[:, GREEN, 0], both),
            )
        )
        at_zero_px, at_one_px = np.split(slopes, 2)
        return cls(at_zero_px, at_one_px - at_zero_px)


def node_blur_px(
    eye: EyeOptics,
    spec: GridSpec,
    rays: GroupRays,
    nodes: RaggedNodes,
    channel_shift_dpt: NDArray[np.float64],
    shrink_ratio: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the largest distance (n_psfs,), px, of rays from the chief ray.

    With several foci, these are the rays of the nearest focus.
    """
    foci_dpt = np.zeros((RGB, 1))
    if eye.rings is not None:
        own_dpt = [
            eye.rings.main_dpt(nm) for nm in spec.channel_wavelengths_nm.tolist()
        ]
        foci_dpt = np.full((RGB, max(map(len, own_dpt))), np.inf)
        for channel, found in enumerate(own_dpt):
            foci_dpt[channel, : len(found)] = found
    zero_px, per_dpt = (np.ascontiguousarray(px.swapaxes(1, 2)) for px in rays)
    blur_px = np.empty(RGB * nodes.values_dpt.size, np.float32)
    loops().call(
        "node_blur",
        *(zero_px, per_dpt, nodes.values_dpt, nodes.starts),
        np.ascontiguousarray(channel_shift_dpt),
        *(foci_dpt, blur_px),
        *(len(zero_px), zero_px.shape[2], foci_dpt.shape[1]),
    )
    return blur_px * np.repeat(shrink_ratio, RGB * nodes.counts).astype(np.float32)
