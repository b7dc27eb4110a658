"""How defocus changes over the field of an eye in one state."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from filter_service.planning.eye import Eye
from filter_service.planning.grid import GridSpec

COLUMNS, ROWS = 13, 9
"""Directions at which the eye is asked.  Between them, over +-40 x 25 deg at 5 mm, the
spline is within 0.0025 dpt (emmetropia, myopia, astigmatism), 0.007 (post-LASIK), 0.009
(keratoconus) and 0.012 (cataract)."""

GREEN = 1


@dataclass(frozen=True)
class FieldDefocus:
    """Total defocus over the field, against that of the direction of gaze.

    Attributes
    ----------
    h_deg, v_deg : (n_h,), (n_v,)
    change_dpt : (n_v, n_h)
    """

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    change_dpt: NDArray[np.float64]

    @classmethod
    def none(cls) -> "FieldDefocus":
        """Return that of an eye whose defocus is the same everywhere."""
        return cls(np.zeros(1), np.zeros(1), np.zeros((1, 1)))

    @cached_property
    def _spline(self) -> RectBivariateSpline:
        return RectBivariateSpline(self.v_deg, self.h_deg, self.change_dpt)

    @property
    def range_dpt(self) -> tuple[float, float]:
        """Smallest and largest change."""
        return float(self.change_dpt.min()), float(self.change_dpt.max())

    def at(self, h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
        """Change (...) in dpt at field directions; at the border's beyond it."""
        h_deg, v_deg = np.broadcast_arrays(h_deg, v_deg)
        if self.change_dpt.size == 1:
            return np.full(h_deg.shape, self.change_dpt[0, 0])
        return self._spline(
            np.clip(v_deg, self.v_deg[0], self.v_deg[-1]),
            np.clip(h_deg, self.h_deg[0], self.h_deg[-1]),
            grid=False,
        )


def field_defocus(
    eye: Eye, spec: GridSpec, *, pupil_diameter_mm: float, accommodation_dpt: float
) -> FieldDefocus:
    """Defocus of green light over the field that a cache is for."""
    if not (spec.follows_field and spec.blends_at_equal_blur):
        return FieldDefocus.none()
    h_deg, v_deg = (
        np.linspace(low, high, count)
        for (low, high), count in zip(
            spec.field_range_deg, (COLUMNS, ROWS), strict=True
        )
    )
    state = {
        "pupil_diameter_mm": pupil_diameter_mm,
        "accommodation_dpt": accommodation_dpt,
        "wavelength_nm": spec.channel_wavelengths_nm[GREEN],
    }
    # The direction of gaze is asked too: it may lie outside of the camera's image.
    at_infinity_dpt = eye.total_defocus_dpt(
        h_deg=np.append(np.tile(h_deg, ROWS), _nearest(h_deg)),
        v_deg=np.append(np.repeat(v_deg, COLUMNS), _nearest(v_deg)),
        **state,
    )
    change_dpt = at_infinity_dpt[:-1] - at_infinity_dpt[-1]
    return FieldDefocus(h_deg, v_deg, change_dpt.reshape(ROWS, COLUMNS))


def _nearest(range_deg: NDArray) -> float:
    return float(np.clip(0.0, range_deg[0], range_deg[-1]))
