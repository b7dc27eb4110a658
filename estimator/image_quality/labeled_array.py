"""Arrays with named axes: the results of `Eye`.

The type is the same whether or not xarray is installed, so that code does not depend on
the environment; `LabeledArray.to_xarray` returns the same data as xarray's type.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTITY = "quantity"
"""Name of the axis whose coordinates are names of quantities, each with its unit."""

MAX_SHOWN = 6
"""Number of coordinates that the representation of an array shows."""

NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class LabeledArray:
    """An array whose axes have names and coordinates.

    NumPy functions accept it in place of `values`.

    Attributes
    ----------
    values : (...)
        Numbers.
    dims : tuple of str
        Name of each axis.
    coords : mapping of str to array
        Coordinates by name: those of each axis, and others that belong to no axis, to
        another one or to several, such as a pupil that is the same for all values.
        Names end in their unit.
    name : str
        Name of the values, which ends in their unit.
    coord_dims : mapping of str to tuple of str
        Axes of the coordinates that are not those of the axis of the same name.
    notes : tuple of str
        Notes on the eye and on parts of a request that could not be fulfilled.
    """

    values: NDArray[Any]
    dims: tuple[str, ...]
    coords: Mapping[str, NDArray[Any]]
    name: str
    coord_dims: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: NONE)
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""
        return self.values.shape

    @property
    def sizes(self) -> dict[str, int]:
        """Length of each axis by its name."""
        return dict(zip(self.dims, self.values.shape, strict=True))

    def __array__(
        self, dtype: DTypeLike | None = None, copy: bool | None = None
    ) -> NDArray[Any]:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __float__(self) -> float:
        return float(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        axes = ", ".join(f"{dim}: {size}" for dim, size in self.sizes.items())
        lines = [f"<LabeledArray {self.name} ({axes})>"]
        for name, values in self.coords.items():
            dims = self.dims_of(name)
            shown = values.ravel()[:MAX_SHOWN].tolist()
            text = ", ".join(
                f"{v:g}" if isinstance(v, float) else str(v) for v in shown
            )
            more = ", ..." if values.size > MAX_SHOWN else ""
            where = "" if dims in ((), (name,)) else f" ({', '.join(dims)})"
            lines.append(f"  {name}{where}: {text}{more}")
        lines.append(np.array2string(self.values, threshold=20, precision=4))
        return "\n".join(lines)

    def dims_of(self, coordinate: str) -> tuple[str, ...]:
        """Return the axes of a coordinate: none if it is the same for all values."""
        return self.coord_dims.get(
            coordinate, (coordinate,) if coordinate in self.dims else ()
        )

    def __getitem__(self, quantity: str) -> LabeledArray:
        """Return one quantity of an array with the axis ``quantity``.

        Raises
        ------
        KeyError
            The array has no such quantity.
        """
        if QUANTITY not in self.dims:
            raise KeyError(
                f"{quantity!r}: {self.name} has no axis of quantities; for a position, "
                "index `values`"
            )
        found = self.sel(**{QUANTITY: quantity})
        coords = {k: v for k, v in found.coords.items() if k != QUANTITY}
        return replace(found, name=quantity, coords=coords)

    def sel(self, **at: Any) -> LabeledArray:
        """Return the values at given coordinates of axes.

        Parameters
        ----------
        **at
            Coordinate by name of its axis, as in ``sel(pupil_diameter_mm=4)``.
            Numbers must agree within 1e-6 of the largest coordinate.

        Raises
        ------
        KeyError
            There is no such axis, or the axis has no such coordinate.
        """
        found = self
        for dim, wanted in at.items():
            found = found._at(dim, wanted)
        return found

    def _at(self, dim: str, wanted: Any) -> LabeledArray:
        if dim not in self.dims:
            raise KeyError(f"{dim!r}: expected one of the axes {', '.join(self.dims)}")
        axis, along = self.dims.index(dim), self.coords.get(dim)
        if along is None:
            along = np.arange(self.shape[axis])
        if along.dtype.kind in "fiu":
            close = 1e-6 * max(float(np.abs(along).max(initial=0.0)), 1e-9)
            is_found = np.abs(along - float(wanted)) <= close
        else:
            is_found = along == wanted
        if not is_found.any():
            raise KeyError(f"{dim} {wanted!r}: expected one of {along.tolist()}")
        index = int(np.argmax(is_found))
        coords = {
            name: np.asarray(
                values.take(index, axis=self.dims_of(name).index(dim))
                if dim in self.dims_of(name)
                else values
            )
            for name, values in self.coords.items()
        }
        dims_of = {
            name: tuple(d for d in self.dims_of(name) if d != dim) for name in coords
        }
        return replace(
            self,
            values=np.asarray(self.values.take(index, axis=axis)),
            dims=tuple(d for d in self.dims if d != dim),
            coords=coords,
            coord_dims=dims_of,
        )

    def columns(self) -> list[str]:
        """Return the column names of `rows`."""
        names = [name for name in self.coords if name != QUANTITY]
        missing = [d for d in self.dims if d not in self.coords]
        if QUANTITY in self.dims:
            return [*missing, *names, *self.coords[QUANTITY].tolist()]
        return [*missing, *names, self.name]

    def rows(self) -> Iterator[list[Any]]:
        """Yield a row for each value: its coordinates, and the value.

        The quantities of an array with the axis ``quantity`` are columns of one row.
        """
        values, dims = self.values, list(self.dims)
        if QUANTITY in dims:
            values = np.moveaxis(values, dims.index(QUANTITY), -1)
            dims.remove(QUANTITY)
        else:
            values = values[..., None]
        names = [name for name in self.coords if name != QUANTITY]
        missing = [k for k, dim in enumerate(dims) if dim not in self.coords]
        axes = [[dims.index(d) for d in self.dims_of(name)] for name in names]
        for index in itertools.product(*map(range, values.shape[:-1])):
            own = [
                self.coords[name][tuple(index[axis] for axis in of)].item()
                for name, of in zip(names, axes, strict=True)
            ]
            yield [*(index[k] for k in missing), *own, *values[index].tolist()]

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with a row for each value.

        The columns are the coordinates and the value, or a column for each quantity.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                "to_pandas requires pandas: pip install pandas"
            ) from error
        return pd.DataFrame(list(self.rows()), columns=self.columns())

    def to_xarray(self) -> Any:
        """Return the same data as an `xarray.DataArray`.

        Raises
        ------
        ImportError
            xarray is not installed.
        """
        try:
            import xarray as xr
        except ImportError as error:
            raise ImportError(
                "to_xarray requires xarray: pip install xarray"
            ) from error
        return xr.DataArray(
            self.values,
            dims=self.dims,
            coords={name: (self.dims_of(name), v) for name, v in self.coords.items()},
            name=self.name,
            attrs={"notes": list(self.notes)},
        )

    def plot(self, *, x: str | None = None) -> Figure:
        """Return a figure of the values, as lines or, for PSFs, as images.

        Parameters
        ----------
        x : str, optional
            Axis of the abscissa; by default the longest one.

        Raises
        ------
        ValueError
            The array has no axis of more than one number, complex values, or too many
            lines or images.
        """
        from estimator.image_quality.plot import figure_of  # matplotlib loads slowly

        return figure_of(self, quantity_axis=QUANTITY, x=x)


def stacked(dim: str, arrays: Mapping[str, LabeledArray]) -> LabeledArray:
    """Return arrays of the same axes as one, along a new first axis.

    Coordinates that differ, or that not every array has, get the new axis; missing
    numbers are NaN.  Notes begin with the name of their array.

    Parameters
    ----------
    dim : str
        Name of the new axis.
    arrays : mapping
        Arrays by their coordinate along it.

    Raises
    ------
    ValueError
        The axes of the arrays differ.
    """
    first, *others = arrays.values()
    for other in others:
        if (other.name, other.sizes) != (first.name, first.sizes):
            raise ValueError(
                f"{other.name} {other.sizes}: expected {first.name} {first.sizes}"
            )
    coords: dict[str, NDArray[Any]] = {dim: np.array([*arrays])}
    coord_dims: dict[str, tuple[str, ...]] = {}
    # Of the array with the most coordinates, for their order.
    for known in sorted(arrays.values(), key=lambda array: -len(array.coords)):
        for name, values in known.coords.items():
            if name in coords:
                continue
            absent = np.full(values.shape, np.nan if values.dtype.kind == "f" else "")
            each = [array.coords.get(name, absent) for array in arrays.values()]
            coords[name], coord_dims[name] = values, known.dims_of(name)
            if not all(np.array_equal(other, values) for other in each):
                coords[name], coord_dims[name] = (
                    np.stack(each),
                    (dim, *coord_dims[name]),
                )
    return labeled(
        np.stack([array.values for array in arrays.values()]),
        (dim, *first.dims),
        coords,
        name=first.name,
        coord_dims=coord_dims,
        notes=tuple(
            f"{k}: {note}" for k, array in arrays.items() for note in array.notes
        ),
    )


def labeled(
    values: ArrayLike,
    dims: tuple[str, ...],
    coords: Mapping[str, ArrayLike],
    **others: Any,
) -> LabeledArray:
    """Return an array with read-only values and coordinates."""
    arrays = {name: np.array(coordinate) for name, coordinate in coords.items()}
    own = np.asarray(values)
    for array in (own, *arrays.values()):
        array.flags.writeable = False
    return LabeledArray(own, dims, arrays, **others)
