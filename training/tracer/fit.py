"""Zernike fit, rim radius and ellipse of completely filled pupils; float64."""

import math

import torch
from torch import Tensor

from estimator.optics.zernike import (
    DEFAULT_ORDER,
    EXPONENTS,
    N_TERMS,
    monomial_matrix,
)
from training.tracer.batches import constant

_FINER = 8
_N_PEAKS = 3
_PEAK_STEPS = 4


@constant
def _from_monomials(device: torch.device) -> Tensor:
    return torch.tensor(monomial_matrix(), device=device)


def zernike_basis(x: Tensor, y: Tensor) -> Tensor:
    """Return polynomial values (B, 28, R) at points (B, R) of the unit circle."""
    powers = []
    for coordinate in (x, y):
        row = [torch.ones_like(coordinate)]
        for _ in range(DEFAULT_ORDER):
            row.append(row[-1] * coordinate)
        powers.append(row)
    monomials = [powers[0][a] * powers[1][b] for a, b in EXPONENTS.tolist()]
    return _from_monomials(x.device) @ torch.stack(monomials, 1)


def fit_zernike(
    x_mm: Tensor, y_mm: Tensor, wave_um: Tensor, weights: Tensor, radius_mm: Tensor
) -> Tensor:
    """Fit W (B, R) by weighted least squares on circles of ``radius_mm`` (B,).

    ``weights`` (R,). Returns coefficients (B, 28), um, with piston zero.
    """
    basis = zernike_basis(x_mm / radius_mm[:, None], y_mm / radius_mm[:, None])
    weighted = basis * weights
    matrix = weighted @ basis.mT
    right = weighted @ wave_um[..., None]
    factor, _ = torch.linalg.cholesky_ex(matrix)
    zernike_um = torch.cholesky_solve(right, factor)[..., 0]
    keep = torch.arange(N_TERMS, device=x_mm.device) > 0
    return torch.where(keep, zernike_um, 0.0)


@constant
def _fourier(n: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return matrix (2 K + 1, n) to the Fourier series of n equal steps, and orders."""
    angle = 2.0 * math.pi * torch.arange(n, dtype=torch.float64) / n
    order = torch.arange(1, (n - 1) // 2 + 1, dtype=torch.float64)
    turned = order[:, None] * angle
    mean = torch.full((1, n), 1.0 / n, dtype=torch.float64)
    rows = (mean, 2.0 / n * turned.cos(), 2.0 / n * turned.sin())
    return torch.cat(rows).to(device), order.to(device)


def _series(
    coefficients: Tensor, order: Tensor, angle: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return value, slope and bend (B, A) of series (B, 2 K + 1) at angles (B, A)."""
    mean, even, odd = coefficients.split([1, len(order), len(order)], dim=-1)
    turned = angle[..., None] * order
    c, s = turned.cos(), turned.sin()
    even, odd = even[:, None], odd[:, None]
    waves = even * c + odd * s
    value = mean + waves.sum(-1)
    slope = (order * (odd * c - even * s)).sum(-1)
    return value, slope, -(order**2 * waves).sum(-1)


def rim_radius(x_mm: Tensor, y_mm: Tensor) -> Tensor:
    """Return the largest distance (B,) of a whole rim (B, n) from the chief ray.

    The squared distance is a smooth function of the stop's azimuth: its Fourier series
    is searched on a finer grid, and the peak refined by Newton's method.
    """
    squared = x_mm**2 + y_mm**2
    n = squared.shape[-1]
    to_series, order = _fourier(n, squared.device)
    coefficients = squared @ to_series.mT
    with torch.no_grad():
        reach = 2.0 * math.pi / (_FINER * n)
        fine = reach * torch.arange(_FINER * n, device=x_mm.device, dtype=x_mm.dtype)
        found = _series(coefficients, order, fine.expand(len(squared), -1))[0]
        highest = (found >= found.roll(1, -1)) & (found >= found.roll(-1, -1))
        # Peaks may have equal height: the grid must not choose between them.
        peaks = torch.where(highest, found, -torch.inf).topk(_N_PEAKS, -1).indices
        start = fine[peaks]
        angle = start
        for _ in range(_PEAK_STEPS):
            _, slope, bend = _series(coefficients, order, angle)
            step = torch.where(bend < 0.0, -slope / bend, 0.0)
            angle = start + (angle + step - start).clamp(-reach, reach)
    # At the peak the angle does not matter to first order: no gradient is lost.
    peak = _series(coefficients, order, angle)[0].amax(-1)
    return torch.maximum(peak, squared.amax(-1)).sqrt()


def rim_ellipse(x_mm: Tensor, y_mm: Tensor, radius_mm: Tensor) -> Tensor:
    """Fit a least-squares conic to rims (B, n), as (B, 5) mm.

    Center x, y and the symmetric matrix xx, xy, yy = R diag(a, b) R^T of the semi-axes
    a, b, where R rotates x to the major axis; nan where the conic is not an ellipse.
    """
    u, v = x_mm / radius_mm[:, None], y_mm / radius_mm[:, None]
    rows = torch.stack([u * u, u * v, v * v, u, v], -1)
    factor, _ = torch.linalg.cholesky_ex(rows.mT @ rows)
    right = rows.sum(-2)[..., None]
    a, b, c, d, e = torch.cholesky_solve(right, factor)[..., 0].unbind(-1)
    determinant = 4.0 * a * c - b * b
    cx = (b * e - 2.0 * c * d) / determinant
    cy = (b * d - 2.0 * a * e) / determinant
    level = 1.0 + a * cx * cx + b * cx * cy + c * cy * cy
    # Squares of the semi-axes: M = Q^-1 of u^T Q u = 1, and the root of M is
    # (M + sqrt(det M)) / sqrt(tr M + 2 sqrt(det M)), smooth where the axes are equal.
    xx, xy, yy = (4.0 * level * s / determinant for s in (c, -0.5 * b, a))
    product = (xx * yy - xy * xy).sqrt()
    root = (xx + yy + 2.0 * product).sqrt()
    parts = [cx, cy, (xx + product) / root, xy / root, (yy + product) / root]
    found = torch.stack(parts, -1) * radius_mm[:, None]
    return torch.where((determinant > 0.0)[:, None], found, torch.nan)
