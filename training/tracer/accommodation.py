"""Lens diameter and chamber depth that focus eyes at given distances, in batches.

The counterpart of `accommodation.AccommodatingEye` with unlimited amplitude: the lens
shrinks at constant volume until the least-squares refraction at 555 nm matches the
focus; an eye that cannot reach it stays relaxed, or goes as far as its lens allows.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from estimator.eye.accommodation import MAX_REFINEMENTS, N_TABLE
from estimator.eye.assembly import (
    ANTERIOR_THICKNESS_RATIO,
    AQUEOUS,
    CAP_VOLUME_RATIO,
    DIAMETER,
    SMALLEST_AQUEOUS_MM,
    SMALLEST_DIAMETER_RATIO,
    VOLUME,
)
from training.tracer.circle import refraction_of_eyes
from training.tracer.eye import lens_shape

_TOLERANCE_DPT = {torch.float64: 1e-6, torch.float32: 2e-4}
"""float32 resolves a refraction to 1e-4 dpt at a pupil of 3 mm."""

_N_WINDOW = 4
_DIFFERENCE_DPT = 1e-3


class Focused(NamedTuple):
    """States of a batch, each tensor shaped like the focus values.

    Attributes
    ----------
    lens_diameter_change_mm, aqueous_thickness_change_mm : (B,) or (B, F)
        Of the accommodated eye minus the relaxed one; nan where not ok.
    ok : bool
        Light passes the relaxed eye, and the refraction was reached.
    """

    lens_diameter_change_mm: Tensor
    aqueous_thickness_change_mm: Tensor
    ok: Tensor


def accommodated_eyes(vectors: Tensor, lens_diameter_mm: Tensor) -> Tensor:
    """Return eyes (..., 45) with other lens diameters (...) at the same volume."""
    relaxed_mm, volume_mm3 = vectors[..., DIAMETER], vectors[..., VOLUME]
    growth_mm = (
        lens_shape(lens_diameter_mm, volume_mm3)[2]
        - lens_shape(relaxed_mm, volume_mm3)[2]
    )
    aqueous_mm = vectors[..., AQUEOUS] - ANTERIOR_THICKNESS_RATIO * growth_mm
    columns = list(vectors.unbind(-1))
    columns[DIAMETER], columns[AQUEOUS] = lens_diameter_mm, aqueous_mm
    return torch.stack(columns, -1)


def smallest_diameters_mm(vectors: Tensor) -> Tensor:
    """Compute `estimator.eye.assembly.smallest_diameter_mm` for a batch."""
    relaxed_mm, volume_mm3 = vectors[..., DIAMETER], vectors[..., VOLUME]
    room_mm = torch.clamp(vectors[..., AQUEOUS] - SMALLEST_AQUEOUS_MM, min=0.0)
    c_mm3 = 8.0 / math.pi * CAP_VOLUME_RATIO * ANTERIOR_THICKNESS_RATIO * volume_mm3
    fitting_mm = (relaxed_mm**-2 + room_mm / c_mm3) ** -0.5
    return torch.maximum(fitting_mm, SMALLEST_DIAMETER_RATIO * relaxed_mm)


class _Table(NamedTuple):
    """Decreasing lens diameters (B, 10), and the accommodation at each.

    ``last`` (B,) is the last entry that the eye can use.
    """

    diameters_mm: Tensor
    accommodations_dpt: Tensor
    relaxed_dpt: Tensor
    last: Tensor


def _tabulate(
    vectors: Tensor, refractions: Callable[[Tensor, Tensor], Tensor]
) -> _Table:
    relaxed_mm = vectors[:, DIAMETER, None]
    share = torch.linspace(0.0, 1.0, N_TABLE, dtype=vectors.dtype)
    shrunk_mm = smallest_diameters_mm(vectors)[:, None] - relaxed_mm
    diameters_mm = relaxed_mm + shrunk_mm * share.to(vectors.device)
    eyes = accommodated_eyes(vectors[:, None].expand(-1, N_TABLE, -1), diameters_mm)
    rows = torch.arange(len(vectors), device=vectors.device)
    rows = rows.repeat_interleave(N_TABLE)
    refractions_dpt = refractions(eyes.flatten(0, 1), rows).unflatten(0, (-1, N_TABLE))
    usable = torch.isfinite(refractions_dpt)
    usable[:, 1:] &= refractions_dpt.diff(dim=1) < 0.0
    usable[:, 0] = True
    last = usable.to(torch.int64).cumprod(1).sum(1) - 1
    relaxed_dpt = refractions_dpt[:, 0]
    return _Table(
        diameters_mm, relaxed_dpt[:, None] - refractions_dpt, relaxed_dpt, last
    )


def _take(table: Tensor, index: Tensor) -> Tensor:
    """Return entries (B, F) of a table (B, 10)."""
    return table.gather(1, index)


def _cubic(table: _Table, right: Tensor, wanted_dpt: Tensor) -> Tensor:
    """Return diameters (B, F) on the cubic through four entries about ``right``."""
    first = (right - 2).clamp(0, N_TABLE - _N_WINDOW)
    window = [first + i for i in range(_N_WINDOW)]
    at_dpt = [_take(table.accommodations_dpt, i) for i in window]
    total_mm = torch.zeros_like(wanted_dpt)
    for i in range(_N_WINDOW):
        share = _take(table.diameters_mm, window[i])
        for k in range(_N_WINDOW):
            if k != i:
                share = share * (wanted_dpt - at_dpt[k]) / (at_dpt[i] - at_dpt[k])
        total_mm = total_mm + share
    rises = [at_dpt[i + 1] > at_dpt[i] for i in range(_N_WINDOW - 1)]
    return torch.where(torch.stack(rises).all(0), total_mm, torch.nan)


def _guess(table: _Table, wanted_dpt: Tensor) -> tuple[Tensor, Tensor]:
    """Return diameters (B, F) by inverse interpolation, and their slopes in mm/dpt.

    Cubic; linear where the table does not increase over the whole window.
    """
    known_dpt, known_mm = table.accommodations_dpt, table.diameters_mm
    position = torch.arange(N_TABLE, device=known_dpt.device)
    rising = torch.where(position > table.last[:, None], torch.inf, known_dpt)
    right = torch.searchsorted(rising.contiguous(), wanted_dpt.contiguous())
    right = torch.minimum(right, table.last[:, None]).clamp(min=1)
    low_dpt, low_mm = _take(known_dpt, right - 1), _take(known_mm, right - 1)
    slope = (_take(known_mm, right) - low_mm) / (_take(known_dpt, right) - low_dpt)
    linear_mm = low_mm + slope * (wanted_dpt - low_dpt)
    at_mm, beside_mm = (
        _cubic(table, right, wanted_dpt + shift) for shift in (0.0, _DIFFERENCE_DPT)
    )
    is_cubic = torch.isfinite(at_mm)
    steeper = (beside_mm - at_mm) / _DIFFERENCE_DPT
    return torch.where(is_cubic, at_mm, linear_mm), torch.where(
        is_cubic, steeper, slope
    )


@torch.no_grad()
def focus_of_eyes(
    vectors: Tensor,
    pupil_diameter_mm: Tensor,
    focus_dpt: Tensor,
    *,
    ray_dtype: torch.dtype | None = None,
    chunk: int | None = None,
) -> Focused:
    """Focus relaxed eyes at given distances; without gradients.

    Parameters
    ----------
    vectors : (B, 45)
        Relaxed eyes.
    pupil_diameter_mm : (B,)
    focus_dpt : (B,) or (B, F)
        Focus distances; infinity is 0.
    ray_dtype, chunk
        As in `training.tracer.circle.zernike_of_eyes`.
    """
    dtype = ray_dtype or vectors.dtype
    vectors = vectors.to(torch.float64)
    wanted_dpt = focus_dpt.to(torch.float64)
    flat = wanted_dpt.ndim == 1
    wanted_dpt = wanted_dpt[:, None] if flat else wanted_dpt

    def refractions(eyes: Tensor, rows: Tensor) -> Tensor:
        pupil_mm = pupil_diameter_mm.to(torch.float64)[rows]
        found, _ = refraction_of_eyes(eyes, pupil_mm, ray_dtype=dtype, chunk=chunk)
        return found.to(torch.float64)

    table = _tabulate(vectors, refractions)
    end = table.last[:, None]
    relaxed_mm = table.diameters_mm[:, :1]
    nearest_mm = _take(table.diameters_mm, end)
    range_dpt = _take(table.accommodations_dpt, end)
    wanted_dpt = wanted_dpt + table.relaxed_dpt[:, None]
    inside = (wanted_dpt > 0.0) & (wanted_dpt < range_dpt)
    guess_mm, slope = _guess(table, wanted_dpt)
    bounds_mm = torch.where(wanted_dpt > 0.0, nearest_mm, relaxed_mm)
    diameter_mm = torch.where(inside, guess_mm, bounds_mm)
    state = (diameter_mm, slope, wanted_dpt, relaxed_mm, nearest_mm)
    met = _refine(vectors, table, refractions, state, inside, _TOLERANCE_DPT[dtype])
    ok = torch.isfinite(table.relaxed_dpt)[:, None] & met
    eyes = accommodated_eyes(vectors[:, None].expand(*met.shape, -1), diameter_mm)
    change_mm = (eyes - vectors[:, None])[..., [DIAMETER, AQUEOUS]]
    change_mm = torch.where(ok[..., None], change_mm, torch.nan).to(dtype)
    found = Focused(change_mm[..., 0], change_mm[..., 1], ok)
    return Focused(*(part[:, 0] for part in found)) if flat else found


def _refine(
    vectors: Tensor,
    table: _Table,
    refractions: Callable[[Tensor, Tensor], Tensor],
    state: tuple[Tensor, ...],
    inside: Tensor,
    tolerance_dpt: float,
) -> Tensor:
    """Refine inside diameters in place by secant steps; return where all converged."""
    diameter_mm, slope, wanted_dpt, relaxed_mm, nearest_mm = state
    met = ~inside
    row, column = inside.nonzero().unbind(1)
    mm, slope = diameter_mm[row, column], slope[row, column]
    wanted_dpt = wanted_dpt[row, column]
    last_mm = last_dpt = None
    for _ in range(MAX_REFINEMENTS):
        if len(row) == 0:
            break
        eyes = accommodated_eyes(vectors[row], mm)
        reached_dpt = table.relaxed_dpt[row] - refractions(eyes, row)
        error_dpt = wanted_dpt - reached_dpt
        done = error_dpt.abs() < tolerance_dpt
        met[row[done], column[done]] = True
        diameter_mm[row, column] = mm
        if last_mm is not None:
            moved_mm, moved_dpt = mm - last_mm, reached_dpt - last_dpt
            # Where only rounding moved it, the old slope is better.
            far = moved_dpt.abs() > 10.0 * tolerance_dpt
            slope = torch.where(far, moved_mm / moved_dpt, slope)
        following_mm = mm + slope * error_dpt
        bounds = (nearest_mm[row, 0], relaxed_mm[row, 0])
        following_mm = torch.minimum(torch.maximum(following_mm, bounds[0]), bounds[1])
        left = ~done & torch.isfinite(error_dpt)
        row, column, slope = row[left], column[left], slope[left]
        last_mm, last_dpt, mm = mm[left], reached_dpt[left], following_mm[left]
        wanted_dpt = wanted_dpt[left]
    return met
