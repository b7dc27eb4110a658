"""The paper's fixed grids as plans.

Angles and distances are those of the released code.  Its foci become nodes of
accommodation.  Its object distances become nodes of the total defocus of green light,
and the other channels are shifted by their chromatic differences.

References
----------
Csoba & Kunkli 2023, section 7.2.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.planning.defocus_nodes import DefocusNodes
from filter_service.planning.grid import GREEN, PAPER_REACH_DEG, GridSpec
from filter_service.planning.node_wavefronts import PupilStates
from filter_service.planning.nodes import PlanAxes, RaggedNodes

ANGLE_COUNTS = {"on-axis": (1, 1), "quality": (31, 21), "dynamic": (23, 13)}
DISTANCE_COUNTS = {"on-axis": 33, "quality": 9, "dynamic": 9}
PUPILS_MM = {
    "on-axis": (2.0, 3.0, 4.0, 5.0, 6.0, 7.0),
    "quality": (5.0,),
    "dynamic": (2.0, 3.0, 4.0, 5.0, 6.0),
}
FOCI_DPT = {
    "on-axis": tuple(0.125 + np.arange(7.0)),
    "quality": (0.125,),
    "dynamic": tuple(0.125 + np.arange(5.0)),
}
DISTANCES_DPT = (0.125, 8.125)


def paper_ranges(
    spec: GridSpec,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of the nodes of pupil, mm, and focus, dpt."""
    settings = spec.settings
    pupils_mm = np.clip(PUPILS_MM[settings.mode], *settings.pupil_range_mm)
    foci_dpt = np.clip(FOCI_DPT[settings.mode], *settings.focus_range_dpt)
    return (
        (float(pupils_mm[0]), float(pupils_mm[-1])),
        (float(foci_dpt[0]), float(foci_dpt[-1])),
    )


def paper_pupils_mm(eye: EyeOptics, spec: GridSpec) -> NDArray[np.float64]:
    """Return the nodes (n,) of the pupil, clamped to the ranges of settings and eye."""
    pupils_mm = np.clip(PUPILS_MM[spec.settings.mode], *spec.settings.pupil_range_mm)
    return np.unique([eye.usable_pupil_mm(pupil_mm) for pupil_mm in pupils_mm])


def paper_axes(eye: EyeOptics, spec: GridSpec) -> PlanAxes:
    """Return the nodes of field, pupil and accommodation.

    Pupils and foci are clamped to the ranges of the settings.  Foci with the same
    accommodation, such as those of a myopic eye beyond its far point, are one node.
    """
    settings, mode = spec.settings, spec.settings.mode
    reach_deg = PAPER_REACH_DEG.get(mode, (0.0, 0.0))
    angles_deg = (
        np.linspace(-reach, reach, count)
        for reach, count in zip(reach_deg, ANGLE_COUNTS[mode], strict=True)
    )
    foci_dpt = np.clip(FOCI_DPT[mode], *settings.focus_range_dpt)
    usable_mm = paper_pupils_mm(eye, spec)
    widest_mm = float(usable_mm[-1])
    accommodations_dpt = np.unique(
        [eye.accommodation_dpt(f, pupil_diameter_mm=widest_mm) for f in foci_dpt]
    )
    # The ends need other accommodations through smaller pupils.
    low_dpt, high_dpt = eye.accommodation_range_dpt(
        (float(foci_dpt[0]), float(foci_dpt[-1])),
        pupil_range_mm=(float(usable_mm[0]), widest_mm),
    )
    accommodations_dpt = np.unique([low_dpt, *accommodations_dpt[1:-1], high_dpt])
    h_deg, v_deg = angles_deg
    return PlanAxes(h_deg, v_deg, usable_mm, accommodations_dpt)


def paper_defocus(eye: EyeOptics, spec: GridSpec, groups: PupilStates) -> DefocusNodes:
    """Return the nodes of total defocus of groups, with the shifts of the channels."""
    at_infinity_dpt = eye.total_defocus_dpt(
        h_deg=groups.h_deg[:, None],
        v_deg=groups.v_deg[:, None],
        pupil_diameter_mm=groups.pupil_diameter_mm[:, None],
        accommodation_dpt=groups.accommodation_dpt[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    green_dpt = at_infinity_dpt[:, GREEN, None]
    count = DISTANCE_COUNTS[spec.settings.mode]
    distances_dpt = np.linspace(*DISTANCES_DPT, count)
    values = green_dpt + eye.vergence.vergence_dpt(distances_dpt)
    starts = count * np.arange(len(values) + 1)
    return DefocusNodes.unlimited(
        RaggedNodes(values.ravel(), starts), at_infinity_dpt - green_dpt
    )
