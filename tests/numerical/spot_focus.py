"""Accommodation by the smallest spot: the paper's criterion, for comparison.

It tries shrunken lenses and keeps the one whose rays from the object land closest
together on the retina (Csoba & Kunkli 2023, 5.2.2).  With spherical aberration that is
another focus than the least-squares refraction `accommodation.py` solves for.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.eye.assembly import accommodated, eye_surfaces
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.optics.surfaces import EyeSurfaces
from estimator.optics.units import MM_PER_M

SPOT_WAVELENGTH_NM = 587.56
SPOT_DIAMETER_RATIO = 0.91
"""Smallest lens diameter that is tried, over the relaxed one."""

N_CANDIDATES = 10
N_ZOOMS = 5
N_RINGS = 6
"""Rings of the hexagonal bundle: 127 rays."""


def hexagonal_disc(n_rings: int) -> NDArray[np.float64]:
    """Points (n, 2) of a hexagonal grid that fills the unit disc's inner hexagon."""
    points = [(0.0, 0.0)]
    for ring in range(1, n_rings + 1):
        corners = [
            (ring * np.cos(k * np.pi / 3.0), ring * np.sin(k * np.pi / 3.0))
            for k in range(7)
        ]
        for (x0, y0), (x1, y1) in pairwise(corners):
            for step in range(ring):
                share = step / ring
                points.append((x0 + share * (x1 - x0), y0 + share * (y1 - y0)))
    return np.array(points) / n_rings


def spot_radius_mm(
    eye: EyeSurfaces, *, object_dpt: float, pupil_diameter_mm: float
) -> float:
    """RMS radius on the retina of the rays of one axial point; inf if none arrive.

    The bundle fills a disc of the pupil's diameter in the plane of the corneal apex.
    """
    aimed_mm = hexagonal_disc(N_RINGS) * pupil_diameter_mm / 2.0
    targets_mm = np.concatenate([aimed_mm, np.zeros((len(aimed_mm), 1))], axis=1)
    if object_dpt > 0.0:
        source_mm = np.array([0.0, 0.0, -MM_PER_M / object_dpt])
        direction = targets_mm - source_mm
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    else:
        direction = np.broadcast_to([0.0, 0.0, 1.0], targets_mm.shape)
    traced = trace_rays(
        eye,
        start_mm=targets_mm - direction * 5.0,  # any start before the cornea
        direction=direction,
        wavelength_nm=SPOT_WAVELENGTH_NM,
    )
    arrived = traced.status_index == RayStatus.TRACED
    if not arrived.any():
        return float("inf")
    spots_mm = traced.points_mm[arrived, -1, :2]
    return float(np.sqrt(np.mean(np.sum((spots_mm - spots_mm.mean(0)) ** 2, axis=1))))


def focus_by_spot(
    parameters: EyeParameters,
    *,
    focus_dpt: float,
    pupil_diameter_mm: float = 4.0,
    retina: RetinaShape | None = None,
) -> EyeParameters:
    """Eye with the lens diameter, within 9 % of the relaxed one, of the smallest spot.

    Parameters
    ----------
    parameters : EyeParameters
        The relaxed eye.
    focus_dpt : float
        Distance of the object, 0 or more.

    Raises
    ------
    ValueError
        A negative distance.
    """
    if not focus_dpt >= 0.0:
        raise ValueError(f"focus {focus_dpt} dpt: must be 0 (infinity) or more")
    relaxed_mm = parameters.lens_diameter_mm
    low_mm, high_mm = SPOT_DIAMETER_RATIO * relaxed_mm, relaxed_mm
    for _ in range(N_ZOOMS):
        candidates_mm = np.linspace(low_mm, high_mm, N_CANDIDATES)
        radii_mm = [
            spot_radius_mm(
                eye_surfaces(
                    accommodated(parameters, lens_diameter_mm=diameter_mm),
                    retina=retina,
                ),
                object_dpt=focus_dpt,
                pupil_diameter_mm=pupil_diameter_mm,
            )
            for diameter_mm in candidates_mm.tolist()
        ]
        best = int(np.argmin(radii_mm))
        low_mm = float(candidates_mm[max(best - 1, 0)])
        high_mm = float(candidates_mm[min(best + 1, N_CANDIDATES - 1)])
    return accommodated(parameters, lens_diameter_mm=float(candidates_mm[best]))
