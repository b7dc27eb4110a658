"""Geometric blur of a plan's nodes, known before any of their PSFs is computed.

Where the layers of frames lie depends on it, so that it must not depend on which PSFs
there are.  Rays land in proportion to defocus: two defocus values of a group tell all.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.constants import RGB
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.nodes import RaggedNodes
from filter_service.planning.readable import PlanAxes
from filter_service.planning.slopes import PupilStates, slopes_px, state_frames


class GroupRays(NamedTuple):
    """Where green rays of each group land, px, at no defocus and by a dioptre more.

    Attributes
    ----------
    zero_px, per_dpt : (n_groups, n_rays, 2)
    """

    zero_px: NDArray[np.float64]
    per_dpt: NDArray[np.float64]

    @classmethod
    def of(cls, eye: EyeOptics, spec: GridSpec, groups: PupilStates) -> "GroupRays":
        """Trace groups through an eye's wavefronts."""
        count = groups.h_deg.size
        columns = vars(groups.taken(np.tile(np.arange(count), 2)))
        columns["total_defocus_dpt"] = np.repeat([0.0, 1.0], count)
        slopes = slopes_px(state_frames(eye, spec, PupilStates(**columns)))
        return cls(slopes[:count], slopes[count:] - slopes[:count])


def groups_of(spec: GridSpec, axes: PlanAxes) -> PupilStates:
    """States (n_groups,) of the groups of a plan, in its order; green, no defocus."""
    return PupilStates.of(
        h_deg=axes.h_deg[:, None, None],
        v_deg=axes.v_deg[:, None, None, None],
        pupil_diameter_mm=axes.pupils_mm[:, None],
        accommodation_dpt=axes.accommodations_dpt,
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
        total_defocus_dpt=0.0,
    )


def node_blur_px(
    eye: EyeOptics,
    spec: GridSpec,
    rays: GroupRays,
    nodes: RaggedNodes,
    channel_shift_dpt: NDArray[np.float64],
    shrink_ratio: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Largest distance (n_psfs,), px, of rays from the chief ray, at PSFs' defocus.

    With several foci it is that of the nearest.
    """
    # Imported here: reading a plan must not load numba.
    from filter_service.planning.blur_loops import fill_blur_px

    foci_dpt = np.zeros((RGB, 1))
    if eye.rings is not None:
        own_dpt = [
            eye.rings.main_dpt(nm) for nm in spec.channel_wavelengths_nm.tolist()
        ]
        foci_dpt = np.full((RGB, max(map(len, own_dpt))), np.inf)
        for channel, found in enumerate(own_dpt):
            foci_dpt[channel, : len(found)] = found
    blur_px = np.empty(RGB * nodes.values_dpt.size, np.float32)
    fill_blur_px(
        *(np.ascontiguousarray(px) for px in rays),
        np.array(nodes.values_dpt, np.float64),
        np.array(nodes.starts, np.int64),
        np.array(channel_shift_dpt, np.float64, order="C"),
        foci_dpt,
        blur_px,
    )
    return blur_px * np.repeat(shrink_ratio, RGB * nodes.counts).astype(np.float32)
