"""Traced part of the visual field, and the pupils traced there."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.given_surfaces import EyeModel, GivenSurfaces
from estimator.eye.tracing import TraceFailed
from estimator.field.aberration_grid import AberrationGrid
from estimator.field.interpolation import (
    FieldInterpolation,
    FieldNodes,
    range_nodes_deg,
)
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import DEFAULT_ORDER, HIGHEST_ORDER, N_TERMS
from estimator.periphery.change import peripheral_change
from estimator.wavefront.aberrations import TRACED_FIELD_LIMIT_DEG, wavefront_grid
from estimator.wavefront.nodes import fewest_nodes

FIELD_PUPIL_RATIOS = (0.64, 1.0)
"""Pupils traced over the field, relative to the largest one."""

LARGE_PUPIL_MM = 7.2
LARGE_FIELD_PUPIL_RATIOS = (0.56, 0.8, 1.0)
"""Pupils traced over the field if the largest exceeds `LARGE_PUPIL_MM`."""

TRACE_ERROR_UM = 0.005
"""RMS error of traced wavefronts through the measured pupil above which they get more
terms."""

CHECKED_DEG = [(0, 0), (-20, 0), (20, 0), (-40, 0), (40, 0), (0, -20), (0, 20)]
"""Directions in which this is checked, whatever the range of fields: an eye has the
same wavefronts in every range."""

ON_AXIS_DEG = ((0.0, 0.0), (0.0, 0.0))
SHRINK_RATIO, SMALLEST_SHARE = 0.85, 0.05
"""Factor by which the traced field shrinks until it is unvignetted, and its limit."""

FieldRange = tuple[tuple[float, float], tuple[float, float]]


def largest_open_pupil_mm(grid: AberrationGrid) -> float:
    """Return the largest pupil of an on-axis grid that is unvignetted in all states.

    Raises
    ------
    TraceFailed
        All pupils are vignetted.
    """
    is_open = FieldInterpolation.is_open(grid)[0, 0].all(axis=(1, 2))
    if not is_open.any():
        raise TraceFailed(
            f"no light passes the eye at {grid.pupil_diameters_mm[0]:g} mm"
        )
    return float(grid.pupil_diameters_mm[is_open][-1])


def field_pupils_mm(low_mm: float, high_mm: float) -> NDArray[np.float64]:
    """Return the pupils (n,), mm, to trace over the field, for a range of pupils."""
    large = high_mm > LARGE_PUPIL_MM
    ratios = LARGE_FIELD_PUPIL_RATIOS if large else FIELD_PUPIL_RATIOS
    pupils_mm = np.maximum(high_mm * np.array(ratios), low_mm)
    return np.unique(pupils_mm)


def traced_terms(eye: EyeModel) -> int:
    """Return the number of terms that the traced wavefronts of an eye need.

    It is 28, or as many as represent the wavefronts of the relaxed eye through the
    measured pupil with an RMS error of `TRACE_ERROR_UM`.  A prescription states no
    higher orders, and a given eye no pupil.
    """
    profile = eye.profile
    if profile.is_given or profile.kind == "prescription":
        return N_TERMS
    for order in range(DEFAULT_ORDER, HIGHEST_ORDER + 1):
        n_terms = (order + 1) * (order + 2) // 2
        n_rings, n_azimuths = fewest_nodes(n_terms)
        found = wavefront_grid(
            eye.relaxed,
            fields_deg=CHECKED_DEG,
            wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
            pupil_diameters_mm=[profile.pupil_diameter_mm],
            plane="pupil",
            n_rings=n_rings,
            n_azimuths=n_azimuths,
            n_terms=n_terms,
        )
        if not (found.rms_residual_um > TRACE_ERROR_UM).any():  # or NaN
            break
    return n_terms


def trace_field(
    eye: EyeModel,
    axis: FieldInterpolation,
    field_range_deg: FieldRange,
    field_grid: Callable[..., AberrationGrid],
    nodes_deg: FieldNodes | None = None,
    **axes: Any,
) -> tuple[FieldInterpolation, FieldRange]:
    """Trace a range of fields, which is shrunk until it is unvignetted.

    Parameters
    ----------
    nodes_deg : (n_h,), (n_v,), optional
        Nodes of the whole range, unless it is shrunk or exceeds
        `TRACED_FIELD_LIMIT_DEG`; by default those of `field_nodes_deg`.

    Returns
    -------
    field : FieldInterpolation
    traced_range_deg : ((h_low, h_high), (v_low, v_high))
    """
    n_rings, n_azimuths = fewest_nodes(axis.grid.zernike_um.shape[-1])
    limited = np.clip(field_range_deg, -TRACED_FIELD_LIMIT_DEG, TRACED_FIELD_LIMIT_DEG)
    share = 1.0
    while share > SMALLEST_SHARE:
        traced = (share * limited).tolist()
        is_whole = np.array_equal(traced, field_range_deg)
        if nodes_deg is None or not is_whole:
            nodes_deg = range_nodes_deg(traced)
        field = FieldInterpolation(
            field_grid(
                eye,
                h_deg=nodes_deg[0],
                v_deg=nodes_deg[1],
                n_rings=n_rings,
                n_azimuths=n_azimuths,
                **axes,
            )
        )
        if field.passes:
            return field, cast(FieldRange, tuple(map(tuple, traced)))
        share *= SHRINK_RATIO
    return axis, ON_AXIS_DEG


def peripheral_residual(
    eye: EyeModel, nodes_deg: FieldNodes
) -> PeripheralResidual | None:
    """Return the phase of the population's periphery for an eye, over a grid.

    It is None if the eye has the periphery of the model, because the profile requests
    it or the phase cannot be traced over the whole range.
    """
    if isinstance(eye, GivenSurfaces) or eye.profile.periphery == "model":
        return None
    if not np.any(np.concatenate(nodes_deg)):
        return None
    residual = PeripheralResidual(peripheral_change(eye.profile), eye, nodes_deg)
    return residual if residual.passes else None


def scaled_progress(
    progress: Callable[[float], None] | None, low: float, high: float
) -> Callable[[float], None] | None:
    """Return a progress callback that maps fractions to [low, high]."""
    if progress is None:
        return None
    return lambda done: progress(low + (high - low) * done)


def check_field_range(field_range_deg: FieldRange) -> None:
    """Check a range of fields.

    Raises
    ------
    ValueError
        The range is not ascending or exceeds 90 degrees.
    """
    for low, high in field_range_deg:
        if not -90.0 < low <= high < 90.0:
            raise ValueError(
                f"field_range_deg {field_range_deg}: needs -90 < low <= high < 90 twice"
            )
