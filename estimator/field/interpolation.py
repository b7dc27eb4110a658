"""Wavefronts of an eye on a grid, and their interpolation.

A grid has axes of field, pupil, accommodation and wavelength.

Wavefronts are interpolated as polynomials in mm of the pupil plane, rims as center and
matrix.  Interpolation is polynomial over the field, with Chebyshev nodes in the angles
of `stretched`, and over accommodation.  Over the pupil, it follows the orders that a
fit omits; see `pupil_powers`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.model import EyeModel
from estimator.eye.focusing import FocusedSurfaces
from estimator.eye.tracing import OPEN_RATIO
from estimator.optics.zernike import N_TERMS, monomial_degrees, radial_order
from estimator.wavefront.aberrations import wavefront_grids
from estimator.wavefront.compiled import chief_shifts_mrad
from estimator.wavefront.field_wavefronts import (
    N_RIM,
    distinct_rows,
    polynomial_in_mm,
    rim_from_ellipse,
)
from estimator.wavefront.nodes import N_AZIMUTHS, N_RINGS

FIELD_RINGS, FIELD_AZIMUTHS = 5, 14
"""Sampling of the stop for fields: 70 rays.

At 7 mm, the error is 1e-3 um, and 0.013 um in the worst case.
"""


@dataclass(frozen=True)
class AberrationGrid:
    """Aberrations on a grid, for an object at infinity and without correction.

    They are traced, or computed by the aberration network.

    Attributes
    ----------
    h_deg, v_deg, pupil_diameters_mm, accommodations_dpt, wavelengths_nm : (n,)
        Nodes of the axes; pupils are entrance pupils at 555 nm.
    zernike_um : (n_h, n_v, n_pupils, n_accommodations, n_wavelengths, n_terms)
        NaN where the chief ray fails.
    zernike_radius_mm, rms_residual_um, open_ratio : without the last axis
    ellipse_mm : with 5 as the last axis
        See `wavefront.FieldResults`.
    chief_shift_mrad : (n_h, n_v, n_accommodations, n_wavelengths, 2)
        Lateral color, see `chief_shift_mrad`.
    """

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    pupil_diameters_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]
    wavelengths_nm: NDArray[np.float64]
    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    rms_residual_um: NDArray[np.float64]
    open_ratio: NDArray[np.float64]
    ellipse_mm: NDArray[np.float64]
    chief_shift_mrad: NDArray[np.float64]


def aberration_grid(
    eye: EyeModel,
    *,
    pupil_diameters_mm: ArrayLike,
    accommodations_dpt: ArrayLike,
    wavelengths_nm: ArrayLike,
    h_deg: ArrayLike = (0.0,),
    v_deg: ArrayLike = (0.0,),
    n_rings: int = N_RINGS,
    n_azimuths: int = N_AZIMUTHS,
    n_terms: int = N_TERMS,
    states: Sequence[FocusedSurfaces] | None = None,
    progress: Callable[[float], None] | None = None,
) -> AberrationGrid:
    """Trace the wavefronts at all nodes of a grid.

    Parameters
    ----------
    eye : EstimatedEye
    pupil_diameters_mm, accommodations_dpt, wavelengths_nm, h_deg, v_deg : (n,)
        Nodes of the axes; accommodations must be within the amplitude.
    n_rings, n_azimuths : int
        Sampling of the stop, see `wavefront.nodes`.
    n_terms : int
        Number of terms of the fit.
    states : (n_accommodations,), optional
        Eye at each accommodation, if already computed.
    progress : callable, optional
        Callback with 1 when the grid is traced; may raise to cancel.

    References
    ----------
    Csoba & Kunkli 2023, section 5.1: the inputs of the aberration estimator.
    """
    h_deg, v_deg, pupils_mm, nodes_dpt, wavelengths_nm = (
        np.atleast_1d(np.asarray(axis, dtype=np.float64))
        for axis in (
            h_deg,
            v_deg,
            pupil_diameters_mm,
            accommodations_dpt,
            wavelengths_nm,
        )
    )
    fields_deg = np.stack(np.meshgrid(h_deg, v_deg, indexing="ij"), axis=-1)
    if states is None:
        states = eye.accommodating.states_at(nodes_dpt)
    eyes = [state.surfaces for state in states]
    found = wavefront_grids(
        eyes,
        fields_deg=fields_deg.reshape(-1, 2),
        wavelengths_nm=wavelengths_nm,
        pupil_diameters_mm=pupils_mm,
        plane="pupil",
        n_rings=n_rings,
        n_azimuths=n_azimuths,
        n_terms=n_terms,
    )
    shift_mrad = chief_shifts_mrad(
        eyes, fields_deg=fields_deg.reshape(-1, 2), wavelengths_nm=wavelengths_nm
    )
    if progress is not None:
        progress(1.0)

    def stacked(name: str) -> NDArray[Any]:
        # (accommodation, field, wavelength, pupil, ...) to the order of the axes
        values: NDArray[Any] = getattr(found, name)
        values = np.moveaxis(values, (1, 3, 0, 2), (0, 1, 2, 3))
        return values.reshape(len(h_deg), len(v_deg), *values.shape[1:])

    shift_mrad = np.moveaxis(shift_mrad, 0, 1)
    return AberrationGrid(
        h_deg=h_deg,
        v_deg=v_deg,
        pupil_diameters_mm=pupils_mm,
        accommodations_dpt=nodes_dpt,
        wavelengths_nm=wavelengths_nm,
        zernike_um=stacked("zernike_um"),
        zernike_radius_mm=stacked("zernike_radius_mm"),
        rms_residual_um=stacked("rms_residual_um"),
        open_ratio=stacked("open_ratio"),
        ellipse_mm=stacked("ellipse_mm"),
        chief_shift_mrad=shift_mrad.reshape(
            len(h_deg), len(v_deg), *shift_mrad.shape[1:]
        ),
    )


NODES_PER_EXTENT = 7.7
"""Field nodes per half extent in stretched angle: 10 for 40 deg, 8 for 25 deg, and
fewer for ranges that are not centered on the axis."""

FAR_DEG, FAR_NODES = 48.0, 9.0
"""Angle beyond which wavefronts change fast, and additional nodes per extent there."""

STRETCH = 1.75

DPT_PER_NODE = 2.0
"""Largest mean step between traced accommodations."""

SMOOTH_NODES = 3
"""Number of traced pupils whose interpolation is smooth; see `pupil_weights`."""

_CHUNK = 16384
_RIM_SCALE = np.array([2, 2, 1, 1, 1])
"""A rim's center scales with the square of the pupil, its axes with the pupil."""


FieldNodes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Azimuths (n_h,) and elevations (n_v,), deg, ascending, of a grid over the field."""


@cache
def pupil_powers(n_terms: int = N_TERMS) -> NDArray[np.float64]:
    """Return powers (n_terms + 5,) of the pupil diameter A with which values change.

    A fit of order 6 omits order 8 (7 if odd), which adds a part proportional to
    A^(8 - degree) to monomials of the same parity.  Rims deviate from their paraxial
    form with A² and, to a lesser degree, A⁴.
    """
    order, degree = radial_order(n_terms), monomial_degrees(n_terms)
    omitted = order + 1 + (order + 1 - degree) % 2
    return np.concatenate([omitted - degree, np.full(N_RIM, 2.3)])


def stretched(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Map angles (...) to a variable in which wavefronts are polynomials of low degree.

    Wavefronts change slowly near the axis and faster with eccentricity, as cos and tan
    do.  Interpolation in the angle itself would need two more nodes.
    """
    return np.arcsinh(STRETCH * np.radians(angle_deg))


def field_nodes_deg(low_deg: float, high_deg: float) -> NDArray[np.float64]:
    """Return Chebyshev nodes (n,) in stretched angle, ascending; one if low is high."""
    low, high = stretched([low_deg, high_deg])
    half = 0.5 * (high - low)
    if half < 1e-9:
        return np.array([low_deg])
    outer = max(abs(low), abs(high))
    far = max(outer - stretched(FAR_DEG), 0.0)
    wanted = 2.0 + NODES_PER_EXTENT * math.sqrt(half * outer) + FAR_NODES * far
    return _chebyshev_deg(0.5 * (low + high), half, math.ceil(wanted))


def range_nodes_deg(
    field_range_deg: tuple[tuple[float, float], tuple[float, float]],
) -> FieldNodes:
    """Return `field_nodes_deg` of azimuths and elevations."""
    across, along = field_range_deg
    return field_nodes_deg(*across), field_nodes_deg(*along)


def fewer_field_nodes_deg(
    nodes_deg: NDArray[np.float64], ratio: float
) -> NDArray[np.float64]:
    """Return nodes reduced by a ratio, over the same range as nodes (n,)."""
    if nodes_deg.size == 1:
        return nodes_deg
    first, last = stretched(nodes_deg[[0, -1]])
    half = 0.5 * (last - first) / math.cos(0.5 * math.pi / nodes_deg.size)
    return _chebyshev_deg(0.5 * (first + last), half, math.ceil(ratio * nodes_deg.size))


def _chebyshev_deg(middle: float, half: float, count: int) -> NDArray[np.float64]:
    """Return Chebyshev nodes over a range of stretched angle."""
    unit = -np.cos(math.pi * (np.arange(count) + 0.5) / count)
    return np.degrees(np.sinh(middle + half * unit) / STRETCH)


def accommodation_nodes_dpt(low_dpt: float, high_dpt: float) -> NDArray[np.float64]:
    """Return Chebyshev-Lobatto nodes (n,), ends included; one if low is high."""
    if high_dpt - low_dpt < 1e-9:
        return np.array([low_dpt])
    last = max(math.ceil((high_dpt - low_dpt) / DPT_PER_NODE), 2)
    unit = 0.5 - 0.5 * np.cos(math.pi * np.arange(last + 1) / last)
    return low_dpt + (high_dpt - low_dpt) * unit


def lagrange_weights(
    nodes: NDArray[np.float64], at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the Lagrange weights (n, n_nodes) of nodes at positions (n,)."""
    nodes, at = np.asarray(nodes, np.float64), np.asarray(at, np.float64)
    gaps = nodes[:, None] - nodes
    np.fill_diagonal(gaps, 1.0)
    weights = np.empty((at.size, nodes.size))
    for i, own_gaps in enumerate(gaps):
        ratios = (at[:, None] - nodes) / own_gaps
        ratios[:, i] = 1.0
        weights[:, i] = ratios.prod(axis=1)
    return weights


def pupil_weights(
    nodes_mm: NDArray[np.float64], pupil_mm: NDArray[Any], n_terms: int = N_TERMS
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the weights of traced pupils at pupils (n,); see `pupil_powers`.

    Of two or more than three traced pupils, the next smaller and the next larger one
    have weights.  Three have one smooth function, with a second power of the diameter:
    between two of them, the slope of M would jump at the middle one, by up to
    0.09 dpt/mm at 40 deg.

    Returns
    -------
    lower : (n,)
        Index of the first pupil with a weight, which is 1 minus the other weights.
    weights : (n, k, n_terms + 5)
        Weights of the k next pupils; k is 0 for one traced pupil, otherwise 1 or 2.
    """
    power = pupil_powers(n_terms)
    if nodes_mm.size == 1:
        return np.zeros(pupil_mm.size, np.int64), np.zeros(
            (pupil_mm.size, 0, power.size)
        )
    if nodes_mm.size == SMOOTH_NODES:
        ratio = nodes_mm / nodes_mm[-1]

        def rises(ratios: NDArray[Any]) -> NDArray[np.float64]:
            """Return powers (n, 2, m) of ratios (n,), minus the powers of the first."""
            powers = np.stack([power, power + 2.0])
            return ratios[:, None, None] ** powers - ratio[0] ** powers

        known = np.moveaxis(rises(ratio[1:]), 2, 0)
        found = np.moveaxis(rises(pupil_mm / nodes_mm[-1]), 2, 0)
        weights = np.moveaxis(found @ np.linalg.inv(known), 0, 2)
        return np.zeros(pupil_mm.size, np.int64), weights
    lower = np.searchsorted(nodes_mm, pupil_mm, side="right") - 1
    lower = np.clip(lower, 0, nodes_mm.size - 2)
    high_mm = nodes_mm[lower + 1]
    least = (nodes_mm[lower] / high_mm)[:, None] ** power
    weight = ((pupil_mm / high_mm)[:, None] ** power - least) / (1.0 - least)
    return lower, weight[:, None]


def _linear(nodes: NDArray[Any], at: NDArray[Any]) -> NDArray[np.float64]:
    """Return weights (n, n_nodes) of linear interpolation, constant outside."""
    return np.stack([np.interp(at, nodes, row) for row in np.eye(nodes.size)], axis=-1)


_Found = TypeVar("_Found", NDArray[Any], tuple[NDArray[Any], ...])


def _evaluate_distinct(
    function: Callable[[NDArray[Any]], _Found], values: NDArray[Any]
) -> _Found:
    """Evaluate a function at values (n,), once for each distinct value."""
    distinct, place = np.unique(values, return_inverse=True)
    found = function(distinct)
    if isinstance(found, tuple):
        return tuple(array[place] for array in found)
    return found[place]


@dataclass(frozen=True)
class FieldValues:
    """Values of a grid at the fields and wavelengths of n requests.

    They are not yet interpolated over pupil and accommodation.

    Attributes
    ----------
    values : (n_fields, n_channels, n_pupils, n_accommodations, n_terms + 5)
    first_pupil : int
        Index in the grid of the first pupil in `values`.
    field, channel : (n,)
        Indices in `values` of the field and wavelength of each request.
    """

    values: NDArray[np.float64]
    first_pupil: int
    field: NDArray[np.int64]
    channel: NDArray[np.int64]

    def select(self, states: NDArray[np.int64]) -> "FieldValues":
        """Return the values of the requests with given indices."""
        return replace(self, field=self.field[states], channel=self.channel[states])


class FieldInterpolation:
    """Interpolation of the wavefronts and rims of a grid.

    A vignetted pupil has the wavefront of the next smaller unvignetted one, because a
    fit to part of a pupil is not continuous with the fits of its neighbors.  Of three
    pupils, the largest has one that is extrapolated from the other two.

    Attributes
    ----------
    grid : AberrationGrid
    passes : bool
        Whether the smallest pupil is unvignetted at all nodes, as the grid requires.
    open_pupil_mm : (n_h, n_v)
        Diameter of the pupil with the unvignetted area, the smallest of all
        accommodations and wavelengths.
    """

    def __init__(self, grid: AberrationGrid):
        self.grid = grid
        pupils_mm = grid.pupil_diameters_mm[:, None, None, None]
        values = np.concatenate(
            [
                polynomial_in_mm(grid.zernike_um, grid.zernike_radius_mm),
                rim_from_ellipse(grid.ellipse_mm) / pupils_mm**_RIM_SCALE,
            ],
            axis=-1,
        )
        self._n_terms = grid.zernike_um.shape[-1]
        is_open = self.is_open(grid)
        nodes_mm = grid.pupil_diameters_mm
        for i in range(1, len(pupils_mm)):
            closed = ~is_open[:, :, i]
            values[:, :, i][closed] = values[:, :, i - 1][closed]
            if i == len(pupils_mm) - 1 == SMOOTH_NODES - 1:
                # so that the smooth interpolation ignores the closed pupil
                reach = self._pupil_weights(nodes_mm[2:], nodes_mm[:2])[1][0, 0]
                low, high = values[:, :, 0][closed], values[:, :, 1][closed]
                values[:, :, i][closed] = low + reach * (high - low)
        passed_mm = pupils_mm[..., 0] * np.sqrt(grid.open_ratio)
        has_chief_rays = np.isfinite(grid.chief_shift_mrad).all()
        self.passes = bool(is_open[:, :, 0].all() and has_chief_rays)
        self.open_pupil_mm = passed_mm.max(axis=2).min(axis=(2, 3))
        self.all_open = bool(is_open.all())
        # (n_h, n_v, n_wavelengths, n_pupils, n_accommodations, n_terms + 5),
        # contiguous for matrix products.
        self._values = np.ascontiguousarray(np.moveaxis(values, 4, 2))

    def add(self, phase_um: NDArray[np.float64]) -> None:
        """Add a phase to the wavefronts of all pupils and wavelengths.

        Parameters
        ----------
        phase_um : (n_h, n_v, n_accommodations, 28), um/mm^degree
        """
        self._values[..., : phase_um.shape[-1]] += phase_um[:, :, None, None]

    def _pupil_weights(
        self, pupil_mm: NDArray[Any], nodes_mm: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return `pupil_weights` of the grid's nodes, or of other ones."""
        if nodes_mm is None:
            nodes_mm = self.grid.pupil_diameters_mm
        return pupil_weights(nodes_mm, pupil_mm, self._n_terms)

    @staticmethod
    def is_open(grid: AberrationGrid) -> NDArray[np.bool_]:
        """Return whether pupils are unvignetted, for all nodes of a grid."""
        is_finite = np.isfinite(grid.zernike_um).all(axis=-1)
        is_finite &= np.isfinite(grid.ellipse_mm).all(axis=-1)
        return is_finite & (grid.open_ratio > OPEN_RATIO)

    def open_pupils_mm(
        self, h_deg: NDArray[Any], v_deg: NDArray[Any]
    ) -> NDArray[np.float64] | None:
        """Return the unvignetted pupils (n,) at fields, or None if all are open."""
        if self.all_open:
            return None
        return np.einsum(
            "nh,nv,hv->n",
            _linear(self.grid.h_deg, h_deg),
            _linear(self.grid.v_deg, v_deg),
            self.open_pupil_mm,
        )

    def at(
        self,
        *,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        pupil_diameter_mm: NDArray[np.float64],
        accommodation_dpt: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return polynomials, um/mm^degree, and rims (n, 5), mm, of states (n,).

        Raises
        ------
        ValueError
            A wavelength was not traced.
        """
        values = self.values(
            h_deg=h_deg,
            v_deg=v_deg,
            wavelength_nm=wavelength_nm,
            pupil_diameter_mm=pupil_diameter_mm,
        )
        return self.between(
            values,
            pupil_diameter_mm=pupil_diameter_mm,
            accommodation_dpt=accommodation_dpt,
        )

    def values(
        self,
        *,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
        pupil_diameter_mm: NDArray[np.float64] | None = None,
    ) -> FieldValues:
        """Return values at fields and wavelengths (n,), for `between`.

        Parameters
        ----------
        pupil_diameter_mm : (n,), optional
            Pupils that will be requested; by default, any of them may be.

        Raises
        ------
        ValueError
            A wavelength was not traced.
        """
        channels, channel = np.unique(
            self._channels(wavelength_nm), return_inverse=True
        )
        first, field = distinct_rows(h_deg, v_deg)
        pupils = slice(0, None)
        if pupil_diameter_mm is not None:
            # Few calls need all wavelengths and pupils.
            lower, shares = self._pupil_weights(pupil_diameter_mm)
            pupils = slice(int(lower.min()), int(lower.max()) + 1 + shares.shape[1])
        values = self._over_field(h_deg[first], v_deg[first], channels, pupils)
        return FieldValues(values, pupils.start, field, channel)

    def between(
        self,
        states: FieldValues,
        *,
        pupil_diameter_mm: NDArray[np.float64],
        accommodation_dpt: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return polynomials, um/mm^degree, and rims (n, 5), mm, of states (n,)."""
        weights = _evaluate_distinct(
            lambda dpt: lagrange_weights(self.grid.accommodations_dpt, dpt),
            accommodation_dpt,
        )
        lower, shares = _evaluate_distinct(self._pupil_weights, pupil_diameter_mm)
        lower = lower - states.first_pupil
        found = np.empty((lower.size, self._n_terms + N_RIM))
        for start in range(0, lower.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            at = states.field[part], states.channel[part]
            low, *higher = (
                np.einsum(
                    "na,nac->nc", weights[part], states.values[*at, lower[part] + k]
                )
                for k in range(1 + shares.shape[1])
            )
            found[part] = low
            for k, high in enumerate(higher):
                found[part] += shares[part, k] * (high - low)
        rim_mm = found[:, -N_RIM:] * pupil_diameter_mm[:, None] ** _RIM_SCALE
        return found[:, :-N_RIM], rim_mm

    def chief_shift_mrad(
        self,
        *,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        accommodation_dpt: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return lateral color (n, 2) of states (n,), mrad; see `chief_shift_mrad`."""
        over_h = lagrange_weights(stretched(self.grid.h_deg), stretched(h_deg))
        over_v = lagrange_weights(stretched(self.grid.v_deg), stretched(v_deg))
        weights = lagrange_weights(self.grid.accommodations_dpt, accommodation_dpt)
        channel = self._channels(wavelength_nm)
        found = np.empty((h_deg.size, 2))
        for c in np.unique(channel):
            at = channel == c
            found[at] = np.einsum(
                "nh,nv,na,hvak->nk",
                *(over_h[at], over_v[at], weights[at]),
                self.grid.chief_shift_mrad[:, :, :, c],
                optimize=True,
            )
        return found

    def _over_field(
        self,
        h_deg: NDArray[Any],
        v_deg: NDArray[Any],
        channels: NDArray[Any],
        pupils: slice,
    ) -> NDArray[np.float64]:
        """Return values (n, n_channels, n_pupils, n_accommodations, m) at fields."""
        over_h = lagrange_weights(stretched(self.grid.h_deg), stretched(h_deg))
        over_v = lagrange_weights(stretched(self.grid.v_deg), stretched(v_deg))
        weights = (over_h[:, :, None] * over_v[:, None, :]).reshape(h_deg.size, -1)
        values = self._values[:, :, channels, pupils]
        found: NDArray[np.float64] = weights @ values.reshape(weights.shape[1], -1)
        return found.reshape(h_deg.size, *values.shape[2:])

    def _channels(self, wavelength_nm: NDArray[Any]) -> NDArray[np.int64]:
        nodes_nm = self.grid.wavelengths_nm
        index: NDArray[np.int64] = np.abs(wavelength_nm[:, None] - nodes_nm).argmin(
            axis=1
        )
        if not np.allclose(nodes_nm[index], wavelength_nm, rtol=1e-6, atol=0.0):
            raise ValueError(
                f"wavelength_nm {np.unique(wavelength_nm).tolist()}: traced are "
                f"{nodes_nm.tolist()}; list others in `wavelengths_nm` of "
                "`prepare_eye`, or use `Eye`, which traces any wavelength"
            )
        return index
