"""Figure of a labeled array: lines over one axis, or images of PSFs."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from estimator.psf.drawing import draw_psf

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_LINES, MAX_IMAGES = 24, 64
IMAGE_AXES = ("y_arcmin", "x_arcmin")

TEXTS = {
    "modulation_ratio": "modulation",
    "light_ratio": "share of the light",
    "log_mar": "acuity, logMAR",
    "retina_log_mar": "limit of the retina, logMAR",
    "visual_strehl_ratio": "visual Strehl ratio",
    "contrast_sensitivity_ratio": "contrast sensitivity",
    "zernike_um": "coefficient, µm",
    "frequency_cpd": "spatial frequency, cycles per degree",
    "radius_arcmin": "radius, arcmin",
    "defocus_dpt": "defocus, dpt",
    "object_dpt": "object distance, dpt",
    "focus_dpt": "focus distance, dpt",
    "pupil_diameter_mm": "pupil, mm",
    "wavelength_nm": "wavelength, nm",
    "orientation_deg": "orientation, deg",
    "h_deg": "h, deg",
    "v_deg": "v, deg",
}


def figure_of(array: Any, *, quantity_axis: str, x: str | None = None) -> Figure:
    """Return the figure of a `LabeledArray`, see `LabeledArray.plot`.

    Parameters
    ----------
    quantity_axis : str
        Axis of quantities, each of which has its own diagram.
    """
    if np.iscomplexobj(array.values):
        raise ValueError(f"{array.name}: complex values cannot be plotted")
    if array.dims[-2:] == IMAGE_AXES:
        return _images(array)
    long = [d for d in array.dims if array.sizes[d] > 1 and d != quantity_axis]
    if x is None and long:
        x = max(long[::-1], key=lambda d: (_is_numeric(array, d), array.sizes[d]))
    if x is None or x not in long:
        raise ValueError(
            f"x {x!r}: expected an axis of more than one number: "
            f"{', '.join(long) or 'there is none'}"
        )
    names = [None]
    if quantity_axis in array.dims:
        names = array.coords[quantity_axis].tolist()
    figure = Figure(figsize=(6.4, 1.2 + 3.2 * len(names)), layout="constrained")
    for axes, name in zip(
        figure.subplots(len(names), 1, squeeze=False).ravel(), names, strict=True
    ):
        _lines(axes, array if name is None else array[name], x)
    return figure


def _lines(axes: Axes, array: Any, x: str) -> None:
    """Draw a line for each combination of the other axes."""
    others = [d for d in array.dims if d != x]
    count = int(np.prod([array.sizes[d] for d in others], dtype=np.int64))
    if count > MAX_LINES:
        raise ValueError(f"{count} lines over {x}: expected at most {MAX_LINES}")
    values = np.moveaxis(array.values, array.dims.index(x), -1)
    at = array.coords.get(x, np.arange(array.sizes[x]))
    for index in itertools.product(*(range(array.sizes[d]) for d in others)):
        label = _label(array, dict(zip(others, index, strict=True)))
        marker = "." if at.size <= MAX_LINES else ""
        axes.plot(at, values[index], marker=marker, label=label or None)
    axes.set_xlabel(TEXTS.get(x, x))
    axes.set_ylabel(TEXTS.get(array.name, array.name))
    axes.grid(visible=True, alpha=0.3)
    if others:
        axes.legend(fontsize="small")
    if array.name.endswith("log_mar"):
        axes.invert_yaxis()  # better is higher, as on charts


def _images(array: Any) -> Figure:
    """Draw PSFs in gray, logarithmic, each with its own peak white."""
    *others, _, _ = array.dims
    count = int(np.prod(array.shape[:-2], dtype=np.int64))
    if count > MAX_IMAGES:
        raise ValueError(f"{count} PSFs: expected at most {MAX_IMAGES} in a figure")
    columns = array.shape[-3] if others else 1
    rows = count // columns
    figure = Figure(figsize=(1.0 + 2.2 * columns, 1.0 + 2.2 * rows), layout="tight")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    x = array.coords["x_arcmin"]
    side = abs(float(x[0])) * (1.0 + 1.0 / max(x.size - 1, 1))
    indices = itertools.product(*(range(array.sizes[d]) for d in others))
    for axes, index in zip(grid.ravel(), indices, strict=True):
        draw_psf(axes, array.values[index], half_side_arcmin=side)
        axes.set_title(
            _label(array, dict(zip(others, index, strict=True))), fontsize="small"
        )
    figure.supxlabel("arcmin", fontsize="small")
    return figure


def _is_numeric(array: Any, dim: str) -> bool:
    return dim not in array.coords or array.coords[dim].dtype.kind in "fiu"


def _label(array: Any, index: dict[str, int]) -> str:
    """Return the coordinates of a line or an image."""
    texts = []
    for dim, position in index.items():
        names = [n for n in array.coords if array.dims_of(n) == (dim,)]
        if not names:
            texts.append(f"{dim} {position}")
        for name in names:
            value = array.coords[name][position].item()
            if isinstance(value, str):
                texts.append(value)
                continue
            if np.isnan(value):  # an eye without this coordinate
                continue
            text = f"{value:g}" if isinstance(value, float) else str(value)
            quantity, _, unit = name.rpartition("_")
            texts.append(f"{quantity.replace('_', ' ')} {text} {unit}".strip())
    return ", ".join(texts)
