"""States of an eye from arguments: numbers, lists, and lists with a shared axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.acuity.transfer import HIGHEST_CPD
from estimator.image_quality.labeled_array import LabeledArray, labeled

Argument = ArrayLike | tuple[str, ArrayLike]
"""A number, a list of numbers, or the name of an axis with a list of numbers."""


class States(TypedDict, total=False):
    """Arguments that describe the states of an eye, see `Eye`."""

    h_deg: Argument
    v_deg: Argument
    pupil_diameter_mm: Argument
    focus_dpt: Argument | None
    object_dpt: Argument
    wavelength_nm: Argument


DEFAULTS: dict[str, float | None] = {
    "h_deg": 0.0,
    "v_deg": 0.0,
    "pupil_diameter_mm": 4.0,
    "focus_dpt": None,
    "object_dpt": 0.0,
    "wavelength_nm": 555.0,
}

LIMITS = {
    "h_deg": (-75.0, 75.0),
    "v_deg": (-75.0, 75.0),
    "pupil_diameter_mm": (0.5, 12.0),
    "focus_dpt": (-20.0, 20.0),
    "object_dpt": (-20.0, 20.0),
    "wavelength_nm": (380.0, 780.0),
}

MAX_STATES = 100_000
MAX_FREQUENCY_CPD = 1000.0


@dataclass(frozen=True)
class StateGrid:
    """All combinations of the given states.

    Attributes
    ----------
    dims : tuple of str
    shape : tuple of int
    coords, coord_dims : dict
        See `LabeledArray`.
    flat : dict of str to (n,) array
        Values of each argument in C order; ``focus_dpt`` is NaN for a relaxed eye.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    coords: dict[str, NDArray[Any]]
    coord_dims: dict[str, tuple[str, ...]]
    flat: dict[str, NDArray[np.float64]]

    @property
    def count(self) -> int:
        """Number of states."""
        return int(np.prod(self.shape, dtype=np.int64))


def state_grid(given: Mapping[str, Any], *, without: tuple[str, ...] = ()) -> StateGrid:
    """Return all combinations of given states.

    Lists of different arguments are combined with each other; arguments with the same
    axis are combined element by element.

    Parameters
    ----------
    given : mapping
        Values of `States`; others have `DEFAULTS`.
    without : tuple of str
        Arguments that are not allowed here.

    Raises
    ------
    TypeError
        An argument is unknown.
    ValueError
        A value is out of range or not a number or list, an axis has several lengths,
        or there are more than `MAX_STATES` combinations.
    """
    allowed = [name for name in DEFAULTS if name not in without]
    for name in given:
        if name not in allowed:
            raise TypeError(
                f"unknown argument {name!r}; expected one of: {', '.join(allowed)}"
            )
    sizes: dict[str, int] = {}
    axis_of: dict[str, tuple[str, ...]] = {}
    values: dict[str, NDArray[np.float64]] = {}
    for name in allowed:
        dim, array = _parsed(name, given.get(name, DEFAULTS[name]))
        axis_of[name], values[name] = (dim,) if array.ndim else (), array
        if array.ndim and sizes.setdefault(dim, array.size) != array.size:
            raise ValueError(
                f"{name}: {array.size} values along the axis {dim!r}; expected "
                f"{sizes[dim]} as for the other arguments of this axis"
            )
    dims, shape = tuple(sizes), tuple(sizes.values())
    count = int(np.prod([float(n) for n in shape]))
    if count > MAX_STATES:
        raise ValueError(
            f"{' x '.join(map(str, shape))} states; expected at most {MAX_STATES}"
        )

    def flat(name: str) -> NDArray[np.float64]:
        array = values[name]
        for dim in axis_of[name]:
            at = [1] * len(dims)
            at[dims.index(dim)] = array.size
            array = array.reshape(at)
        return np.broadcast_to(array, shape).ravel()

    shared = {n: d for n, d in axis_of.items() if d and d != (n,)}
    shown = {n: v for n, v in values.items() if not np.isnan(v).all()}
    return StateGrid(
        dims=dims,
        shape=shape,
        coords=dict(shown),
        coord_dims={name: dim for name, dim in shared.items() if name in shown},
        flat={name: flat(name) for name in allowed},
    )


def _parsed(name: str, given: Any) -> tuple[str, NDArray[np.float64]]:
    """Return the axis of an argument and its values, () or (n,)."""
    dim, value = name, given
    if isinstance(given, tuple) and given and isinstance(given[0], str):
        if len(given) != 2:
            raise ValueError(f"{name} {given!r}: expected (name of axis, list)")
        dim, value = given
    if value is None and name == "focus_dpt":
        return dim, np.array(np.nan)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} {value!r}: expected a number or a list of numbers"
        ) from None
    if array.ndim > 1 or array.size == 0:
        raise ValueError(
            f"{name} has shape {array.shape}: expected a number or a list of numbers; "
            "for lists that are combined element by element, name their axis, as in "
            "h_deg=('direction', [0, 10]), v_deg=('direction', [0, 5])"
        )
    low, high = LIMITS[name]
    wrong = array[~((array >= low) & (array <= high))]
    if wrong.size:
        raise ValueError(
            f"{name} {float(wrong.flat[0]):g}: expected {low:g} to {high:g}"
        )
    return dim, array


def frequencies_cpd(given: ArrayLike, *, white_light: bool) -> NDArray[np.float64]:
    """Return frequencies () or (n,) that a transfer function has."""
    highest_cpd = HIGHEST_CPD if white_light else MAX_FREQUENCY_CPD
    return listed("frequency_cpd", given, (0.0, highest_cpd))


def listed(
    name: str, given: ArrayLike, limits: tuple[float, float]
) -> NDArray[np.float64]:
    """Return a number () or list (n,) within limits."""
    found = np.asarray(given, dtype=np.float64)
    if found.ndim > 1 or found.size == 0:
        raise ValueError(
            f"{name} has shape {found.shape}: expected a number or a list of numbers"
        )
    low, high = limits
    wrong = found[~((found >= low) & (found <= high))]
    if wrong.size:
        raise ValueError(
            f"{name} {float(wrong.flat[0]):g}: expected {low:g} to {high:g}"
        )
    return found


def check_choice(name: str, value: str, allowed: Sequence[str]) -> None:
    """Raise ValueError if a value is not one of those allowed."""
    if value not in allowed:
        raise ValueError(f"{name} {value!r}: expected one of: {', '.join(allowed)}")


def result_of(
    grid: StateGrid,
    values: NDArray[Any],
    own: Mapping[str, NDArray[Any]],
    name: str,
    notes: tuple[str, ...],
    *,
    coords: Mapping[str, NDArray[Any]] | None = None,
    fixed: Mapping[str, NDArray[Any]] | None = None,
) -> LabeledArray:
    """Return values (n, ...) of states (n,) as an array with named axes.

    Parameters
    ----------
    own : mapping
        Coordinates of the axes after those of the states; a number is no axis.
    coords : mapping, optional
        Other coordinates, in the shape of the states.
    fixed : mapping, optional
        Other numbers that apply to all values.
    """
    dims = tuple(dim for dim, along in own.items() if along.ndim)
    sizes = tuple(own[dim].size for dim in dims)
    per_state = coords or {}
    return labeled(
        values.reshape((*grid.shape, *sizes)),
        (*grid.dims, *dims),
        {**grid.coords, **per_state, **(fixed or {}), **own},
        name=name,
        coord_dims={**grid.coord_dims, **dict.fromkeys(per_state, grid.dims)},
        notes=notes,
    )
