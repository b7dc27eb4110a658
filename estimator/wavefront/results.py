"""Result types for wavefronts and their pupils."""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.optics.raytrace import STATUS_WORDS, RayStatus
from estimator.wavefront import compiled


@dataclass(frozen=True)
class PupilEllipse:
    """Least-squares ellipse of the rim of the projected pupil.

    Attributes
    ----------
    centre_x_mm, centre_y_mm : float
        Center relative to the chief ray.
    semi_major_mm, semi_minor_mm : float
    major_axis_deg : float
        Angle of the major axis from +x toward +y, 0 to 180.
    """

    centre_x_mm: float
    centre_y_mm: float
    semi_major_mm: float
    semi_minor_mm: float
    major_axis_deg: float

    @classmethod
    def of(cls, columns: NDArray[np.float64]) -> "PupilEllipse":
        """Return the ellipse of center, semi-axes, mm, and angle, rad, (5,)."""
        x_mm, y_mm, major_mm, minor_mm, angle_rad = columns.tolist()
        return cls(x_mm, y_mm, major_mm, minor_mm, math.degrees(angle_rad))

    @property
    def axis_ratio(self) -> float:
        """Ratio of the minor to the major semi-axis."""
        return self.semi_minor_mm / self.semi_major_mm


@dataclass(frozen=True)
class FieldResults:
    """Wavefronts and pupils of several fields, wavelengths, stops or eyes.

    Attributes
    ----------
    zernike_um : (..., n_terms)
        Coefficients; piston is zero; nan where the chief ray fails.
    zernike_radius_mm : (...)
        Radius of their circle: the largest distance of the rim from the chief ray.
    ellipse_mm : (..., 5)
        Center x, y, semi-axes major, minor (mm) and angle of the major axis (rad).
    rms_residual_um : (...)
        RMS residual of the fit of W.
    open_ratio : (...)
        Unvignetted fraction of the stop's area.
    chief_status_index, worst_status_index : (...) int
        `RayStatus` of the chief ray, and the worst of all rays.
    retinal_point_mm : (..., 3)
        Intersection of the chief ray with the retina.
    pupil_point_mm : (..., 3)
        Intersection of the chief ray with the cornea or with the plane of the entrance
        pupil: the origin of the plane of the wavefront.
    """

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    ellipse_mm: NDArray[np.float64]
    rms_residual_um: NDArray[np.float64]
    open_ratio: NDArray[np.float64]
    chief_status_index: NDArray[np.int64]
    worst_status_index: NDArray[np.int64]
    retinal_point_mm: NDArray[np.float64]
    pupil_point_mm: NDArray[np.float64]

    def at(self, index: int) -> "FieldResults":
        """Return the results at an index of the first axis."""
        return FieldResults(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def from_rows(cls, rows: NDArray[Any]) -> "FieldResults":
        """Unpack rows (..., n_terms + N_OTHER); see `compiled.stop_rows`."""
        n_terms = rows.shape[-1] - compiled.N_OTHER
        other = rows[..., n_terms:]
        retina, plane = compiled.RETINA_POINT, compiled.PLANE_POINT
        return cls(
            zernike_um=rows[..., :n_terms],
            zernike_radius_mm=other[..., compiled.RADIUS],
            ellipse_mm=other[..., compiled.ELLIPSE : compiled.RMS],
            rms_residual_um=other[..., compiled.RMS],
            open_ratio=other[..., compiled.OPEN_SHARE],
            chief_status_index=other[..., compiled.CHIEF_STATUS].astype(np.int64),
            worst_status_index=other[..., compiled.WORST_STATUS].astype(np.int64),
            retinal_point_mm=other[..., retina : retina + 3],
            pupil_point_mm=other[..., plane : plane + 3],
        )


@dataclass(frozen=True)
class Aberrations:
    """Aberrations for one field, wavelength and stop; fields as in `FieldResults`."""

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: float
    pupil_ellipse: PupilEllipse
    rms_residual_um: float
    stop_diameter_mm: float
    open_ratio: float
    chief_status: RayStatus
    worst_status: RayStatus
    retinal_point_mm: NDArray[np.float64]
    pupil_point_mm: NDArray[np.float64]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on vignetting; empty for an unvignetted pupil."""
        if self.chief_status != RayStatus.TRACED:
            return (f"no chief ray: {STATUS_WORDS[self.chief_status]}",)
        if self.worst_status != RayStatus.TRACED:
            reason = STATUS_WORDS[self.worst_status]
            return (f"vignetted to {self.open_ratio:.1%} of the stop ({reason})",)
        return ()
