"""Progressive spectacle lenses, whose power changes with the direction of gaze.

Manufacturers do not publish their surfaces.  The surface used here is U(y) with U'' = F
on the corridor x = 0, smoothed along y with a Gaussian of width |x|.  F is the
cumulative normal distribution with a quarter of the corridor as its standard deviation.

- On the corridor, the power is F(y) in all meridians, from distance power to addition.
- Beside it, the surface has the astigmatism 2 |F'(y)| x at an oblique axis, which no
  smooth surface can avoid (Minkwitz, Optica Acta 10, 1963).  It levels off at 0.8 of
  the addition.
- The power changes across the pupil as well, which causes coma and trefoil: 0.07 um
  through 4 mm in the middle of a 14 mm corridor with an addition of 2 dpt.  The third
  derivatives of the surface describe all but 0.005 um of them there, and all but
  0.02 um at the ends of the corridor.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics import prescription as rx
from estimator.optics.units import MM_PER_M
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM
from estimator.optics.zernike import EXPONENTS, N_TERMS
from estimator.wavefront.field_wavefronts import polynomial_in_mm

ROTATION_CENTER_MM = 13.5
"""Depth of the eye's center of rotation behind the cornea."""


def lens_point_mm(
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    vertex_mm: float,
    gaze_deg: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points x and y (...), mm, where field directions cross a lens.

    The origin is in front of the pupil in primary gaze.  Gaze rotates about the eye's
    center of rotation, field directions about the entrance pupil.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Field directions relative to the line of sight.
    vertex_mm : float
        Distance from lens to cornea.
    gaze_deg : (h, v)
        Gaze relative to the head.
    """
    by_gaze_mm = vertex_mm + ROTATION_CENTER_MM
    by_field_mm = vertex_mm + TYPICAL_ENTRANCE_PUPIL_MM
    x, y = (
        by_gaze_mm * np.tan(np.radians(gaze)) + by_field_mm * np.tan(direction)
        for gaze, direction in zip(
            gaze_deg, (np.radians(h_deg), np.radians(v_deg)), strict=True
        )
    )
    return x, y


CUBES = [EXPONENTS.tolist().index([a, 3 - a]) for a in (3, 2, 1, 0)]
"""Indices of the monomials x³, x²y, xy² and y³."""


@dataclass(frozen=True)
class ProgressiveLens(rx.Prescription):
    """A progressive lens; its `Prescription` is the power on the line of sight.

    Attributes
    ----------
    distance : Prescription
        Prescription for distance vision.
    add_dpt : float
        Addition.
    corridor_mm : float
        Length of the corridor, from 2 % of the addition at the fitting cross (in front
        of the pupil in primary gaze) down to 98 % of the addition.
    gaze_deg : (h, v)
        Gaze relative to the head.
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
        """Build a lens from its distance prescription, for a direction of gaze."""
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

    def with_gaze_offset(self, offset_deg: tuple[float, float]) -> "ProgressiveLens":
        """Return the lens after a rotation of gaze by (h, v) from ``gaze_deg``."""
        h_deg, v_deg = (
            gaze + offset
            for gaze, offset in zip(self.gaze_deg, offset_deg, strict=True)
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
        """Return the points x and y (...), mm, where field directions cross the lens.

        The origin is the fitting cross; see `lens_plane.lens_point_mm`.
        """
        return lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )

    def power_matrices_dpt(self, x_mm: ArrayLike, y_mm: ArrayLike) -> NDArray[Any]:
        """Return dioptric power matrices (..., 2, 2) at points of the lens.

        Axes are x to the person's right and y up.
        """
        # Imported here so that the service starts without loading scipy.
        from scipy.special import ndtr

        along, lateral, _ = self._corridor_coordinates(x_mm, y_mm)
        power_dpt = self.add_dpt * ndtr(along)
        bell_dpt = self.add_dpt * _bell(along)
        found = np.empty((*along.shape, 2, 2))
        found[..., 0, 0] = power_dpt - bell_dpt * along * lateral**2
        found[..., 1, 1] = power_dpt
        found[..., 0, 1] = found[..., 1, 0] = -bell_dpt * lateral
        m, j0, j45 = rx.power_vector(replace(self.distance, vertex_mm=0.0))
        far_dpt: NDArray[np.float64] = np.array([[m + j0, j45], [j45, m - j0]])
        return found + far_dpt

    def power_gradient_polynomial(
        self, x_mm: ArrayLike, y_mm: ArrayLike
    ) -> NDArray[Any]:
        """Return the monomials (..., 28) that the gradient of the power subtracts.

        They are cubic, from the third derivatives of the surface at the given points.
        """
        along, lateral, width_mm = self._corridor_coordinates(x_mm, y_mm)
        slope_dpt_mm = self.add_dpt * _bell(along) / width_mm
        derivatives = [
            along * lateral * ((3.0 - along * along) * lateral**2 - 3.0),  # xxx
            -1.0 - (along * along - 1.0) * lateral**2,  # xxy
            -along * lateral,  # xyy
            -np.ones_like(along),  # yyy
        ]
        found = np.zeros((*along.shape, N_TERMS))
        for index, factor, third in zip(CUBES, (1, 3, 3, 1), derivatives, strict=True):
            found[..., index] = -slope_dpt_mm * factor * third / 6.0
        return found

    def _corridor_coordinates(
        self, x_mm: ArrayLike, y_mm: ArrayLike
    ) -> tuple[NDArray[Any], ...]:
        """Return positions along and across the corridor, in widths, and the width."""
        x, y = np.broadcast_arrays(*(np.asarray(c, float) for c in (x_mm, y_mm)))
        width_mm = np.hypot(self.corridor_mm / 4.0, x)
        return (-y - self.corridor_mm / 2.0) / width_mm, x / width_mm, width_mm


def progressive_polynomial(
    lens: ProgressiveLens,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    entrance_pupil_mm: float,
) -> NDArray[np.float64]:
    """Return the monomials (..., 28), um/mm^degree, that a lens subtracts in the pupil.

    The power matrix P at the vertex distance becomes P (1 - L P)^-1 at the entrance
    pupil, at a distance L.  The effect of the power gradient is added.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Field directions.
    entrance_pupil_mm : float
        Depth of the entrance pupil behind the cornea.
    """
    point_mm = lens.lens_point_mm(h_deg, v_deg)
    power = lens.power_matrices_dpt(*point_mm)
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
    return parts @ polynomial_in_mm(unit, 1.0) + lens.power_gradient_polynomial(
        *point_mm
    )


def _bell(along: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.exp(-along * along / 2.0) / np.sqrt(2.0 * np.pi)
