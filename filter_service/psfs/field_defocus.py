"""Change of total defocus over the field of an eye in one state."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics.interpolation import CubicSpline
from filter_service.planning.grid import GREEN, GridSpec

COLUMNS, ROWS = 17, 11
"""Number of directions at which the eye is evaluated.  Between them, over +-40 x 25 deg
at 5 mm, the largest error of the spline is 0.011 dpt (emmetropia), 0.022 dpt
(keratoconus) and 0.030 dpt (myopia).  It occurs in the corners, where no people were
measured; 99 % of the field is within 0.008, 0.014 and 0.021 dpt.  With 13 x 9
directions, the largest error is 0.055 dpt in myopia, and a new state takes 0.1 ms
less."""

EXACT_PARTS = 3
"""Parts into which the intervals between directions are divided for the PSFs of a
single state."""


class FieldAxes:
    """Directions at which the eye is evaluated, and the spline between them.

    A spline is a linear combination of cardinal splines, which do not depend on its
    values, so a new state costs one matrix product.

    Parameters
    ----------
    h_deg, v_deg : (n_h,), (n_v,)
    """

    def __init__(self, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]):
        self.h_deg, self.v_deg = h_deg, v_deg

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.v_deg.size, self.h_deg.size

    @cached_property
    def _splines(self) -> tuple[CubicSpline, CubicSpline]:
        rows, columns = (
            CubicSpline(axis, np.eye(axis.size)) for axis in (self.v_deg, self.h_deg)
        )
        return rows, columns

    def weights(
        self, h_deg: ArrayLike, v_deg: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return weights (..., n_v) and (..., n_h) at clamped directions."""
        h_deg, v_deg = np.broadcast_arrays(h_deg, v_deg)
        if self.shape == (1, 1):
            return np.ones((*h_deg.shape, 1)), np.ones((*h_deg.shape, 1))
        row_spline, column_spline = self._splines
        return (
            row_spline(np.clip(v_deg, self.v_deg[0], self.v_deg[-1])),
            column_spline(np.clip(h_deg, self.h_deg[0], self.h_deg[-1])),
        )


@dataclass(frozen=True)
class FieldDefocus:
    """Total defocus over the field, relative to that in the gaze direction.

    Attributes
    ----------
    axes : FieldAxes
    change_dpt : (n_v, n_h)
    """

    axes: FieldAxes
    change_dpt: NDArray[np.float64]

    @classmethod
    def none(cls) -> "FieldDefocus":
        """Return the field defocus of an eye without any change over the field."""
        return cls(FieldAxes(np.zeros(1), np.zeros(1)), np.zeros((1, 1)))

    @property
    def range_dpt(self) -> tuple[float, float]:
        """Smallest and largest change."""
        return float(self.change_dpt.min()), float(self.change_dpt.max())

    def at(self, h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the change (...), dpt, at field directions, clamped to the range."""
        return self.of_weights(self.axes.weights(h_deg, v_deg))

    def of_weights(
        self, weights: tuple[NDArray[Any], NDArray[Any]]
    ) -> NDArray[np.float64]:
        """Return the change (...) for weights of `FieldAxes.weights`."""
        row_weights, column_weights = weights
        # One product of matrices: NumPy multiplies stacks of them one by one.
        by_column = row_weights.reshape(-1, row_weights.shape[-1]) @ self.change_dpt
        found_dpt: NDArray[np.float64] = np.einsum(
            "ij,ij->i", by_column, column_weights.reshape(by_column.shape)
        )
        return found_dpt.reshape(row_weights.shape[:-1])


class EyeDefocus:
    """Total defocus of an eye at field nodes and over the field, state by state.

    Parameters
    ----------
    h_deg, v_deg : (n_fields,)
        Field nodes.
    """

    def __init__(
        self,
        eye: EyeOptics,
        spec: GridSpec,
        *,
        h_deg: NDArray[Any],
        v_deg: NDArray[Any],
    ):
        wavelengths_nm = spec.channel_wavelengths_nm
        h, v, nm = (
            column.ravel()
            for column in np.broadcast_arrays(
                np.reshape(h_deg, (-1, 1)), np.reshape(v_deg, (-1, 1)), wavelengths_nm
            )
        )
        self._node_shape = (np.size(h_deg), wavelengths_nm.size)
        self._axes: FieldAxes | None = None
        if spec.follows_field and spec.blends_at_equal_blur:
            (left, right), (down, up) = spec.field_range_deg
            parts = EXACT_PARTS if spec.is_exact else 1
            self._axes = FieldAxes(
                np.linspace(left, right, parts * (COLUMNS - 1) + 1),
                np.linspace(down, up, parts * (ROWS - 1) + 1),
            )
            self._node_weights = self._axes.weights(h_deg, v_deg)
            over_h_deg, over_v_deg = _directions(self._axes.h_deg, self._axes.v_deg)
            h, v = np.append(h, over_h_deg), np.append(v, over_v_deg)
            nm = np.append(nm, np.full(over_h_deg.size, wavelengths_nm[GREEN]))
        self._defocus_dpt = eye.defocus_at(h_deg=h, v_deg=v, wavelength_nm=nm)

    def state(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> tuple[NDArray[np.float64], FieldDefocus]:
        """Return the total defocus (n_fields, 3) at infinity, and its field change.

        The change over the field is computed for green light.
        """
        at_infinity_dpt = self._defocus_dpt(
            pupil_diameter_mm=pupil_diameter_mm, accommodation_dpt=accommodation_dpt
        )
        n_nodes = int(np.prod(self._node_shape))
        nodes_dpt = at_infinity_dpt[:n_nodes].reshape(self._node_shape)
        if self._axes is None:
            return nodes_dpt, FieldDefocus.none()
        over_dpt = at_infinity_dpt[n_nodes:]
        change_dpt = over_dpt[:-1] - over_dpt[-1]
        return nodes_dpt, FieldDefocus(self._axes, change_dpt.reshape(self._axes.shape))

    def change_at_nodes_dpt(self, change: FieldDefocus) -> NDArray[np.float64]:
        """Return the change (n_fields, 1) of a state at the field nodes."""
        if self._axes is None:
            return np.zeros((self._node_shape[0], 1))
        return change.of_weights(self._node_weights)[:, None]


def _directions(
    h_deg: NDArray[Any], v_deg: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return azimuths and elevations of a grid, by rows, and of the gaze direction.

    The gaze direction is included because it may lie outside the camera's image.
    """
    return (
        np.append(np.tile(h_deg, v_deg.size), _nearest(h_deg)),
        np.append(np.repeat(v_deg, h_deg.size), _nearest(v_deg)),
    )


def _nearest(range_deg: NDArray[Any]) -> float:
    return float(np.clip(0.0, range_deg[0], range_deg[-1]))
