"""A progressive lens: spectacles whose power changes with the direction of gaze.

No manufacturer publishes a surface.  This one is U(y) with U'' = F, along the corridor
x = 0, smoothed vertically by a normal distribution as wide as |x|.  On the corridor it
has the power F(y) in every meridian, from far to the addition.  Beside the corridor it
has the astigmatism 2 |F'(y)| x with an oblique axis, which no smooth surface can avoid
(Minkwitz, Optica Acta 10, 1963) and which levels off at 0.8 of the addition.  F is the
normal distribution itself, a quarter of the corridor wide.

Power changes over the pupil too, which causes coma and trefoil: 0.07 um through 4 mm in
the middle of a corridor of 14 mm to 2 dpt.  They are modeled by the surface's third
derivatives, which omit 0.005 um of the wavefront there, and 0.02 um at the corridor's
ends.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.lens_plane import lens_point_mm
from estimator.optics import prescription as rx
from estimator.optics.units import MM_PER_M
from estimator.optics.zernike import EXPONENTS, N_TERMS
from estimator.wavefront.field_wavefronts import polynomial_in_mm

CUBES = [EXPONENTS.tolist().index([a, 3 - a]) for a in (3, 2, 1, 0)]
"""Indices of the monomials x³, x²y, xy² and y³."""


@dataclass(frozen=True)
class ProgressiveLens(rx.Prescription):
    """A progressive lens; as a `Prescription` it has the power seen by the fovea.

    Attributes
    ----------
    distance : Prescription
        Prescription for far.
    add_dpt : float
    corridor_mm : float
        Length from the fitting cross, in front of the pupil of an eye that looks
        straight ahead and with 2 % of the addition, down to 98 % of the addition.
    gaze_deg : (h, v)
        Gaze relative to straight ahead of the head.
    """

    distance: rx.Prescription = field(default_factory=lambda: rx.Prescription(0.0))
    add_dpt: float = 0.0
    corridor_mm: float = 14.0
    gaze_deg: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls,
        distance: rx.Prescription,
        *,
        add_dpt: float,
        corridor_mm: float,
        gaze_deg: tuple[float, float] = (0.0, 0.0),
    ) -> "ProgressiveLens":
        """Return the lens for a direction of gaze."""
        lens = cls(
            **vars(distance),
            distance=distance,
            add_dpt=add_dpt,
            corridor_mm=corridor_mm,
            gaze_deg=gaze_deg,
        )
        power = lens.power_matrices_dpt(*lens.lens_point_mm(0.0, 0.0))
        m_dpt = float(power[0, 0] + power[1, 1]) / 2.0
        j0_dpt = float(power[0, 0] - power[1, 1]) / 2.0
        seen = rx.prescription_from_power_vector(m_dpt, j0_dpt, float(power[0, 1]))
        seen = replace(seen, vertex_mm=distance.vertex_mm)
        return replace(lens, **vars(seen))

    def looking(self, gaze_deg: tuple[float, float]) -> "ProgressiveLens":
        """Return the lens for a gaze rotated by (h, v) from the present one."""
        h_deg, v_deg = (
            own + more for own, more in zip(self.gaze_deg, gaze_deg, strict=True)
        )
        return ProgressiveLens.of(
            self.distance,
            add_dpt=self.add_dpt,
            corridor_mm=self.corridor_mm,
            gaze_deg=(h_deg, v_deg),
        )

    def lens_point_mm(
        self, h_deg: ArrayLike, v_deg: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y (...) where light from field directions crosses the lens.

        The origin is the fitting cross, see `lens_plane`.
        """
        return lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )

    def power_matrices_dpt(self, x_mm: ArrayLike, y_mm: ArrayLike) -> NDArray[Any]:
        """Return the power (..., 2, 2) at points of the lens, x to the right, y up."""
        # Imported here so that the service starts without loading scipy.
        from scipy.special import ndtr

        z, aside, _ = self._places(x_mm, y_mm)
        power_dpt = self.add_dpt * ndtr(z)
        bell_dpt = self.add_dpt * _bell(z)
        found = np.empty((*z.shape, 2, 2))
        found[..., 0, 0] = power_dpt - bell_dpt * z * aside**2
        found[..., 1, 1] = power_dpt
        found[..., 0, 1] = found[..., 1, 0] = -bell_dpt * aside
        m, j0, j45 = rx.power_vector(replace(self.distance, vertex_mm=0.0))
        far_dpt: NDArray[np.float64] = np.array([[m + j0, j45], [j45, m - j0]])
        return found + far_dpt

    def uneven_polynomial(self, x_mm: ArrayLike, y_mm: ArrayLike) -> NDArray[Any]:
        """Return monomials (..., 28) subtracted by the power's change over the pupil.

        Uses the third derivatives of the surface at the point on the line of sight.
        """
        z, aside, wide_mm = self._places(x_mm, y_mm)
        slope_dpt_mm = self.add_dpt * _bell(z) / wide_mm
        derivatives = [
            z * aside * ((3.0 - z * z) * aside**2 - 3.0),  # xxx
            -1.0 - (z * z - 1.0) * aside**2,  # xxy
            -z * aside,  # xyy
            -np.ones_like(z),  # yyy
        ]
        found = np.zeros((*z.shape, N_TERMS))
        for place, times, third in zip(CUBES, (1, 3, 3, 1), derivatives, strict=True):
            found[..., place] = -slope_dpt_mm * times * third / 6.0
        return found

    def _places(self, x_mm: ArrayLike, y_mm: ArrayLike) -> tuple[NDArray[Any], ...]:
        """Return positions along and across the corridor over its width; the width."""
        x, y = np.broadcast_arrays(*(np.asarray(c, float) for c in (x_mm, y_mm)))
        wide_mm = np.hypot(self.corridor_mm / 4.0, x)
        return (-y - self.corridor_mm / 2.0) / wide_mm, x / wide_mm, wide_mm


def progressive_polynomial(
    lens: ProgressiveLens,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    entrance_pupil_mm: float,
) -> NDArray[np.float64]:
    """Return monomials (..., 28) that a lens subtracts at field directions (...).

    In the plane of the entrance pupil, by meridians: P (1 - L P)^-1, plus the change of
    power over the pupil.
    """
    place_mm = lens.lens_point_mm(h_deg, v_deg)
    power = lens.power_matrices_dpt(*place_mm)
    before_m = (lens.vertex_mm + entrance_pupil_mm) / MM_PER_M
    at_pupil = power @ np.linalg.inv(np.eye(2) - before_m * power)
    m = (at_pupil[..., 0, 0] + at_pupil[..., 1, 1]) / 2.0
    j0 = (at_pupil[..., 0, 0] - at_pupil[..., 1, 1]) / 2.0
    unit = np.stack(
        [
            rx.zernike_from_power_vector(*row, zernike_radius_mm=1.0)
            for row in np.eye(3).tolist()
        ]
    )
    parts = np.stack([m, j0, at_pupil[..., 0, 1]], axis=-1)
    found: NDArray[np.float64] = parts @ polynomial_in_mm(
        unit, 1.0
    ) + lens.uneven_polynomial(*place_mm)
    return found


def _bell(z: NDArray[np.float64]) -> NDArray[np.float64]:
    bell: NDArray[np.float64] = np.exp(-z * z / 2.0) / np.sqrt(2.0 * np.pi)
    return bell
