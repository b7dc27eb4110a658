"""Wavefronts over the field, with only one wavelength traced at every node.

Colors differ from each other far less than the wavefront changes over the field, and
more smoothly.  So the other wavelengths are traced at fewer fields and accommodations,
and their difference from the first one is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.given_surfaces import EyeModel
from estimator.eye.focusing import FocusedSurfaces
from estimator.field.aberration_grid import AberrationGrid, aberration_grid
from estimator.field.interpolation import (
    FieldInterpolation,
    fewer_field_nodes_deg,
    lagrange_weights,
    stretched,
)
from estimator.field.trace_range import share_of
from estimator.wavefront.field_wavefronts import ellipse_from_rim, rim_from_ellipse

FIELD_RATIO = 0.7
"""Ratio of the other colors' field nodes to those of the first, along each axis:
7 x 6 for 10 x 8.  Wavefronts at random fields are then within 0.98e-3 um of traced ones
(RMS, emmetropia, 5 mm) instead of 0.95e-3; with 6 x 5, within 1.2e-3."""

FEW_ACCOMMODATIONS = 3
"""Largest number of accommodations of the other colors; two give 2.1e-3 um."""

FIRST_SHARE = 0.6
"""Fraction of the time that the first color takes."""

COLOR_AXIS = {"chief_shift_mrad": 3}
"""Color axis of a grid's array, where it is not the fifth axis."""


def few_colors_grid(
    eye: EyeModel,
    *,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    accommodations_dpt: ArrayLike,
    wavelengths_nm: ArrayLike,
    states: Sequence[FocusedSurfaces] | None = None,
    progress: Callable[[float], None] | None = None,
    **sampling: Any,
) -> AberrationGrid:
    """Return the grid of `aberration_grid` in about half the time.

    If any node is vignetted, every color is traced at every node.

    Parameters
    ----------
    h_deg, v_deg : (n_h,), (n_v,)
        Field nodes, as `field_nodes_deg` places them.
    accommodations_dpt : (n_accommodations,)
    wavelengths_nm : (n_wavelengths,)
        Ascending; the middle one is traced at every node.
    states : (n_accommodations,), optional
        Eye at each accommodation, if already computed.
    progress : callable, optional
        Callback with the completed fraction after each accommodation; may raise to
        cancel.
    **sampling
        Pupils and rays, see `aberration_grid`.

    Raises
    ------
    ValueError
        Values are out of range, or the eye cannot be traced.
    """
    nm, used_dpt = np.atleast_1d(wavelengths_nm), np.atleast_1d(accommodations_dpt)
    place = {"h_deg": np.atleast_1d(h_deg), "v_deg": np.atleast_1d(v_deg)}
    middle = nm.size // 2
    known = eye.accommodating.states_at(used_dpt) if states is None else states

    def traced(
        of_nm: NDArray[Any],
        at: dict[str, Any],
        some: NDArray[Any],
        *shares: float,
    ) -> AberrationGrid:
        return aberration_grid(
            eye,
            **at,
            accommodations_dpt=used_dpt[some],
            wavelengths_nm=of_nm,
            states=[known[k] for k in some.tolist()],
            progress=share_of(progress, *shares),
            **sampling,
        )

    every = np.arange(used_dpt.size)
    first = traced(nm[middle : middle + 1], place, every, 0.0, FIRST_SHARE)
    if nm.size == 1:
        return first
    rest_nm, rest, left = np.delete(nm, middle), None, (FIRST_SHARE, 1.0)
    if _passes(first):
        few = {
            name: fewer_field_nodes_deg(at, FIELD_RATIO) for name, at in place.items()
        }
        ends = np.linspace(0, used_dpt.size - 1, FEW_ACCOMMODATIONS)
        coarse = traced(rest_nm, few, np.unique(ends.round().astype(int)), *left)
        if _passes(coarse):
            rest = _like(first, coarse)
    if rest is None:
        rest = traced(rest_nm, place, every, *left)
    return _joined(first, rest, middle)


def _passes(grid: AberrationGrid) -> bool:
    return bool(
        FieldInterpolation.is_open(grid).all()
        and np.isfinite(grid.chief_shift_mrad).all()
    )


def _like(first: AberrationGrid, coarse: AberrationGrid) -> AberrationGrid:
    """Interpolate the other colors from few nodes to the nodes of the first."""
    to_coarse, to_all = (
        [
            lagrange_weights(transformed(nodes), transformed(at))
            for nodes, at, transformed in (
                (from_.h_deg, to.h_deg, stretched),
                (from_.v_deg, to.v_deg, stretched),
                (from_.accommodations_dpt, to.accommodations_dpt, np.asarray),
            )
        ]
        for from_, to in ((first, coarse), (coarse, first))
    )

    def of(name: str) -> NDArray[np.float64]:
        known, few = getattr(first, name), getattr(coarse, name)
        if name == "ellipse_mm":
            known, few = rim_from_ellipse(known), rim_from_ellipse(few)
        axis = COLOR_AXIS.get(name, 4) - 1  # of the accommodations
        found = known + _moved(few - _moved(known, to_coarse, axis), to_all, axis)
        return ellipse_from_rim(found) if name == "ellipse_mm" else found

    names = [f.name for f in fields(first) if getattr(first, f.name).ndim > 1]
    return replace(
        first,
        wavelengths_nm=coarse.wavelengths_nm,
        **{name: of(name) for name in names},
    )


def _moved(
    values: NDArray[np.float64], weights: list[NDArray[np.float64]], axis: int
) -> NDArray[np.float64]:
    """Interpolate values [h, v, ...] to other nodes of field and accommodation."""
    for along, own in zip((0, 1, axis), weights, strict=True):
        values = np.moveaxis(np.tensordot(own, values, (1, along)), 0, along)
    return values


def _joined(first: AberrationGrid, rest: AberrationGrid, middle: int) -> AberrationGrid:
    """Return the first color's grid with the others around it."""

    def of(name: str) -> NDArray[np.float64]:
        own: NDArray[np.float64]
        own, others = getattr(first, name), getattr(rest, name)
        if own.ndim == 1:
            return own
        axis = COLOR_AXIS.get(name, 4)
        before, after = np.split(others, [middle], axis=axis)
        return np.concatenate([before, own, after], axis=axis)

    nm = np.insert(rest.wavelengths_nm, middle, first.wavelengths_nm)
    names = (f.name for f in fields(first) if f.name != "wavelengths_nm")
    return AberrationGrid(wavelengths_nm=nm, **{name: of(name) for name in names})
