"""An estimated eye as the PSF cache asks for it: every wavefront ray-traced.

Answers the same questions as `measured_wavefront.MeasuredWavefront`, without its
limits: pupils larger than the measured one are traced, not extrapolated, and
accommodation changes the lens and with it all aberrations.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator import prescription as rx
from estimator.aberration_grid import AberrationGrid, aberration_grid
from estimator.estimation import EstimatedEye
from estimator.measured_wavefront import request_notes
from estimator.units import SPHERE_PER_C20
from estimator.zernike import rescale_pupil

MAX_PUPIL_MM = 8.0
"""Largest pupil an iris opens to."""

ACCOMMODATION_STEP_DPT = 1.0
"""Largest step between traced accommodations; blending is at equal defocus, so only the
slow change of the other aberrations is interpolated."""

ON_AXIS = (0, 0)


class TraceFailed(ValueError):
    """No light passes the eye at the smallest pupil asked for."""


class TracedEye:
    """On-axis wavefronts of an estimated eye on the nodes of an aberration grid.

    Attributes
    ----------
    grid : AberrationGrid
    refraction_dpt, amplitude_dpt : float
        M at 555 nm and the measured pupil, through the worn correction; reach.
    """

    def __init__(self, eye: EstimatedEye, grid: AberrationGrid):
        on_axis = grid.zernike_um[ON_AXIS]
        open_mm = grid.pupil_diameters_mm[
            np.isfinite(on_axis).all(axis=(1, 2, 3))
            & (grid.open_ratio[ON_AXIS] > 0.999).all(axis=(1, 2))
        ]
        if open_mm.size == 0:
            raise TraceFailed(
                f"no light passes the eye at {grid.pupil_diameters_mm[0]:g} mm"
            )
        self.grid = grid
        self.refraction_dpt = eye.refraction_dpt
        self.amplitude_dpt = eye.amplitude_dpt
        self.max_pupil_diameter_mm = float(open_mm[-1])
        self._correction = (
            rx.power_vector(eye.profile.correction)
            if (eye.profile.correction)
            else None
        )
        self._zernike_um = self._on_nominal_circles(on_axis)

    def _on_nominal_circles(self, on_axis: NDArray) -> NDArray[np.float64]:
        """Coefficients (n_pupils, n_accommodations, n_wavelengths, 28) at pupil / 2.

        The traced rim lies within a per cent of the paraxial entrance pupil.
        """
        radius_mm = self.grid.pupil_diameters_mm[:, None, None] / 2.0
        ratio = radius_mm / self.grid.zernike_radius_mm[ON_AXIS]
        finite = np.isfinite(ratio)
        scaled = rescale_pupil(
            np.nan_to_num(on_axis), radius_ratio=np.where(finite, ratio, 1.0)
        )
        scaled[..., 0] = 0.0
        if self._correction is not None:
            for k, r in enumerate(radius_mm.ravel()):
                scaled[k] -= rx.zernike_from_power_vector(
                    *self._correction, zernike_radius_mm=float(r)
                )
        return scaled

    @classmethod
    def trace(
        cls,
        eye: EstimatedEye,
        *,
        pupil_diameters_mm: ArrayLike,
        focus_range_dpt: tuple[float, float],
        wavelengths_nm: ArrayLike,
        progress: Callable[[float], None] | None = None,
    ) -> "TracedEye":
        """Trace the grid that a range of pupils and foci needs, on axis."""
        used_dpt = [eye.accommodating.accommodation_dpt(f) for f in focus_range_dpt]
        low_dpt, high_dpt = min(used_dpt), max(used_dpt)
        count = 1 + int(np.ceil((high_dpt - low_dpt) / ACCOMMODATION_STEP_DPT - 1e-9))
        return cls(
            eye,
            aberration_grid(
                eye,
                pupil_diameters_mm=pupil_diameters_mm,
                accommodations_dpt=np.linspace(low_dpt, high_dpt, max(count, 1)),
                wavelengths_nm=np.unique(wavelengths_nm),
                progress=progress,
            ),
        )

    def accommodation_dpt(self, focus_dpt: float) -> float:
        """Accommodation a = clamp(f + M(555 nm), 0, amplitude) for a focus distance."""
        return min(max(focus_dpt + self.refraction_dpt, 0.0), self.amplitude_dpt)

    def reachable_focus_dpt(self, focus_dpt: float) -> float:
        """Distance, dpt, that the eye is really focused at when asked for this one."""
        return self.accommodation_dpt(focus_dpt) - self.refraction_dpt

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Pupil asked for, capped where the iris or the traced light ends."""
        return min(pupil_diameter_mm, self.max_pupil_diameter_mm)

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Say in words what of the request this eye cannot meet."""
        return request_notes(
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            max_pupil_diameter_mm=self.max_pupil_diameter_mm,
            pupil_limit="traced",
            refraction_dpt=self.refraction_dpt,
            amplitude_dpt=self.amplitude_dpt,
        )

    def accommodation_nodes_dpt(
        self, focus_range_dpt: tuple[float, float]
    ) -> NDArray[np.float64]:
        """Return the traced accommodations."""
        return self.grid.accommodations_dpt

    def total_defocus_dpt(
        self,
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
        wavelength_nm: float,
    ) -> float:
        """Least-squares refraction for an object at infinity, between traced nodes.

        What is interpolated is the small difference to M(lambda) - a.
        """
        pupils_mm = self.grid.pupil_diameters_mm
        used_dpt = self.grid.accommodations_dpt
        c20_um = self._zernike_um[:, :, self._wavelength(wavelength_nm), rx.C20]
        m_dpt = -SPHERE_PER_C20 * c20_um / (pupils_mm[:, None] / 2.0) ** 2
        over_pupils = [
            np.interp(pupil_diameter_mm, pupils_mm, column)
            for column in (m_dpt + used_dpt).T
        ]
        return float(
            np.interp(accommodation_dpt, used_dpt, over_pupils) - accommodation_dpt
        )

    def zernike_at_defocus(
        self,
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
        wavelength_nm: float,
        total_defocus_dpt: float,
    ) -> NDArray[np.float64]:
        """Coefficients (28,), um, of a traced node with its defocus replaced."""
        pupil = _nearest(self.grid.pupil_diameters_mm, pupil_diameter_mm)
        used = _nearest(self.grid.accommodations_dpt, accommodation_dpt)
        zernike_um = self._zernike_um[pupil, used, self._wavelength(wavelength_nm)]
        zernike_um = zernike_um.copy()
        radius_mm = pupil_diameter_mm / 2.0
        zernike_um[rx.C20] = -total_defocus_dpt * radius_mm**2 / SPHERE_PER_C20
        return zernike_um

    def _wavelength(self, wavelength_nm: float) -> int:
        return _nearest(self.grid.wavelengths_nm, wavelength_nm)


def _nearest(nodes: NDArray[np.float64], value: float) -> int:
    index = int(np.argmin(np.abs(nodes - value)))
    if abs(nodes[index] - value) > 1e-6 * max(abs(value), 1.0):
        raise ValueError(f"{value} is not one of the traced nodes {nodes.tolist()}")
    return index
