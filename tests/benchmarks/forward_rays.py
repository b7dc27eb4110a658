"""Where an eye is really sharpest, by rays that run inwards from an object.

The service finds wavefronts by rays that leave the eye.  Here they come from a point at
a distance from the entrance pupil and land on the retina: their optical paths to the
image point are the wavefront, whatever the service thinks of the eye.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from estimator.optics.media import refractive_index
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.raytrace import RayStatus, TracedRays, trace_rays
from estimator.optics.surfaces import EyeSurfaces
from estimator.optics.units import MM_PER_M, UM_PER_MM
from estimator.optics.zernike import EXPONENTS
from tests.numerical.spot_focus import hexagonal_disc

N_RINGS = 48
"""Of the hexagonal bundle: 7,057 rays, two thirds of which pass the stop.  With 16
rings the pupil's edge is so coarse that strong spherical aberration shows 0.1 dpt."""

AIMED_RATIO = 1.15
"""Of the bundle's radius to the pupil's: the stop decides what passes."""

N_RIM = 72

START_MM = 8.0
"""Rays start so far before the cornea, at equal paths from the object."""

WAVELENGTH_NM = 555.0

SEARCH_DPT = 1.5
"""To either side of the focus asked for."""


@dataclass(frozen=True)
class ForwardEye:
    """An eye at one state of its lens, seen through one pupil.

    Attributes
    ----------
    surfaces : EyeSurfaces
    pupil_diameter_mm, pupil_z_mm : float
        Entrance pupil: its size and plane.
    centre_mm : (2,)
        Where the chief ray, through the middle of the stop, meets that plane.
    stop_radius_mm : float
        Of the iris through which light from afar fills a pupil of that diameter: no
        farther from the chief ray anywhere.
    rest_um : (28,), um/mm^degree
        A phase in the pupil, about the chief ray, beside what rays show.
    """

    surfaces: EyeSurfaces
    pupil_diameter_mm: float
    pupil_z_mm: float
    centre_mm: NDArray[np.float64]
    rest_um: NDArray[np.float64]
    stop_radius_mm: float = np.inf

    @classmethod
    def of(
        cls, surfaces: EyeSurfaces, *, pupil_diameter_mm: float, rest_um: NDArray
    ) -> "ForwardEye":
        """Return it with its chief ray."""
        pupil_z_mm = entrance_pupil_mm(surfaces, wavelength_nm=WAVELENGTH_NM)
        centre_mm = np.zeros(2)
        for _ in range(6):
            eye = cls(surfaces, pupil_diameter_mm, pupil_z_mm, centre_mm, rest_um)
            traced = eye.traced(centre_mm[None], 0.0)
            centre_mm = centre_mm - traced.points_mm[0, traced.stop_index, :2]
        angles = 2.0 * np.pi * np.arange(N_RIM) / N_RIM
        rim_mm = np.column_stack([np.cos(angles), np.sin(angles)])
        traced = eye.traced(eye.centre_mm + rim_mm * pupil_diameter_mm / 2.0, 0.0)
        at_stop_mm = traced.points_mm[:, traced.stop_index, :2]
        return replace(eye, stop_radius_mm=float(np.hypot(*at_stop_mm.T).min()))

    def traced(self, aimed_mm: NDArray, object_dpt: float) -> TracedRays:
        """Rays of a point on the chief ray, through points (n, 2) of the pupil."""
        through_mm = np.column_stack(
            [aimed_mm, np.full(len(aimed_mm), self.pupil_z_mm)]
        )
        axis = np.array([0.0, 0.0, 1.0])
        if object_dpt == 0.0:
            direction = np.tile(axis, (len(aimed_mm), 1))
            start_mm = through_mm - (START_MM + self.pupil_z_mm) * axis
        else:
            away_mm = MM_PER_M / object_dpt
            source_mm = np.append(self.centre_mm, self.pupil_z_mm) - away_mm * axis
            direction = np.sign(object_dpt) * (through_mm - source_mm)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            start_mm = source_mm + (away_mm - self.pupil_z_mm - START_MM) * direction
        return trace_rays(
            self.surfaces,
            start_mm=start_mm,
            direction=direction,
            wavelength_nm=WAVELENGTH_NM,
        )

    def wavefront_um(self, object_dpt: float) -> tuple[NDArray, NDArray]:
        """Points (n, 2) of the pupil over its radius, and W (n,) without piston, tilt.

        W is by how much the chief ray's path to the sphere about its image point,
        through the middle of the stop, exceeds that of each ray.

        Raises
        ------
        ValueError
            Rays that do not arrive.
        """
        unit = AIMED_RATIO * hexagonal_disc(N_RINGS) * 2.0 / np.sqrt(3.0)
        aimed_mm = self.centre_mm + unit * self.pupil_diameter_mm / 2.0
        traced = self.traced(np.vstack([self.centre_mm, aimed_mm]), object_dpt)
        at_stop_mm = traced.points_mm[1:, traced.stop_index, :2]
        passes = np.hypot(*at_stop_mm.T) <= self.stop_radius_mm
        unit = unit[passes]
        traced = _taken(traced, np.append(True, passes))
        if not (traced.status_index == RayStatus.TRACED).all():
            raise ValueError(f"{self.pupil_diameter_mm:g} mm: not all rays arrive")
        vitreous = refractive_index(
            self.surfaces.surfaces[-1].medium_after,
            WAVELENGTH_NM,
            indices=self.surfaces.indices,
        )
        ends_mm, cosines = traced.points_mm[:, -1], traced.direction_ratio[:, -2]
        aside_mm = ends_mm - ends_mm[0]
        radius_mm = ends_mm[0, 2] - self.surfaces.stop_z_mm
        along_mm = np.sum(aside_mm * cosines, axis=1)
        room_mm2 = radius_mm**2 - np.sum(aside_mm**2, axis=1) + along_mm**2
        path_mm = traced.path_mm[:, -1] - vitreous * (along_mm + np.sqrt(room_mm2))
        x, y = unit.T * self.pupil_diameter_mm / 2.0
        w_um = UM_PER_MM * (path_mm[0] - path_mm[1:])
        w_um += sum(
            c * x**a * y**b for c, (a, b) in zip(self.rest_um, EXPONENTS, strict=True)
        )
        plane = np.column_stack([np.ones(len(unit)), unit])
        return unit, w_um - plane @ np.linalg.lstsq(plane, w_um, rcond=None)[0]

    def rms_um(self, object_dpt: float) -> float:
        """Root mean square of the wavefront from a distance."""
        return float(np.sqrt(np.mean(self.wavefront_um(object_dpt)[1] ** 2)))

    def sharpest_dpt(self, near_dpt: float) -> float:
        """Distance of the smallest RMS, about one."""
        return float(
            minimize_scalar(
                self.rms_um,
                bounds=(near_dpt - SEARCH_DPT, near_dpt + SEARCH_DPT),
                method="bounded",
                options={"xatol": 1e-5},
            ).x
        )


def _taken(rays: TracedRays, which: NDArray[np.bool_]) -> TracedRays:
    return TracedRays(
        *(
            values[which]
            for values in (
                rays.points_mm,
                rays.direction_ratio,
                rays.path_mm,
                rays.status_index,
            )
        ),
        rays.stop_index,
    )
