"""Compiled fits to wavefront samples: Zernike coefficients, rim radius, ellipse."""

import math

import numpy as np
from numba import njit

from estimator.optics.zernike import MAX_RADIAL_ORDER, N_TERMS, monomial_matrix
from estimator.wavefront.kernels import SLOPE_X, SLOPE_Y, W, X, Y

_FROM_MONOMIALS = np.ascontiguousarray(monomial_matrix().T)  # [monomial, j]
_ORDER = MAX_RADIAL_ORDER
_PIVOT_LIMIT = 1e-13
"""Smallest pivot, relative to the diagonal, of a regular matrix."""

_RIM_STEPS = 20
_NO_DERIVATIVE = np.int64(0)
"""A plain 0 has a different type and would compile the loops twice."""

# --- columns of the ellipse ---
CENTER_X, CENTER_Y, SEMI_MAJOR, SEMI_MINOR, MAJOR_AXIS_RAD = 0, 1, 2, 3, 4
N_ELLIPSE = 5


@njit(cache=True, nogil=True, error_model="numpy")
def cholesky_solve(matrix, right):
    """Solve a symmetric system in place from its lower triangle; False if singular."""
    n = matrix.shape[0]
    for i in range(n):
        diagonal = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > _PIVOT_LIMIT * diagonal:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * right[k]
        right[i] = total / matrix[i, i]
    for i in range(n - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, n):
            total -= matrix[k, i] * right[k]
        right[i] = total / matrix[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _add_row(matrix, row, weight):
    """Add weight * row row^T to the lower triangle."""
    for i in range(row.shape[0]):
        factor = weight * row[i]
        for j in range(i + 1):
            matrix[i, j] += factor * row[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _product(x, y, out):
    for i in range(x.shape[0]):
        out[i] = x[i] * y[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _add_scaled(factor, x, out):
    for i in range(x.shape[0]):
        out[i] += factor * x[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _dot(x, y):
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _powers(x, y):
    px, py = np.ones((_ORDER + 1, x.shape[0])), np.ones((_ORDER + 1, x.shape[0]))
    for i in range(_ORDER):
        _product(px[i], x, px[i + 1])
        _product(py[i], y, py[i + 1])
    return px, py


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(px, py, d_x, d_y, basis):
    """Write the polynomials (28, n) or their derivatives of order ``d_x``, ``d_y``."""
    basis[:] = 0.0
    monomial = np.empty(px.shape[1])
    t = -1
    for degree in range(_ORDER + 1):
        for b in range(degree + 1):
            a = degree - b
            t += 1
            if a < d_x or b < d_y:
                continue
            factor = (a if d_x else 1.0) * (b if d_y else 1.0)
            _product(px[a - d_x], py[b - d_y], monomial)
            for j in range(N_TERMS):
                if _FROM_MONOMIALS[t, j] != 0.0:
                    _add_scaled(factor * _FROM_MONOMIALS[t, j], monomial, basis[j])


@njit(cache=True, nogil=True, error_model="numpy")
def zernike_basis(x, y):
    """Return the polynomials (28, n) at points (n,) of the unit circle."""
    basis = np.empty((N_TERMS, x.shape[0]))
    px, py = _powers(x, y)
    _combine(px, py, _NO_DERIVATIVE, _NO_DERIVATIVE, basis)
    return basis


@njit(cache=True, nogil=True, error_model="numpy")
def _add_normal_equations(basis, values, weights, first, matrix, right):
    weighted = np.empty(values.shape[0])
    for i in range(first, N_TERMS):
        _product(basis[i], weights, weighted)
        right[i - first] += _dot(weighted, values)
        for j in range(first, i + 1):
            matrix[i - first, j - first] += _dot(weighted, basis[j])


@njit(cache=True, nogil=True, error_model="numpy")
def fit_zernike(samples, weights, radius_mm, use_slopes, zernike_um):
    """Fit Zernike coefficients to samples by weighted least squares.

    Parameters
    ----------
    samples : (n, N_SAMPLE)
        Position (mm), W (um) and slopes (um/mm).
    weights : (n,)
        Zero excludes a sample.
    radius_mm : float
        Radius of the circle of the coefficients.
    use_slopes : bool
        Fit the slopes (Algorithm 1) instead of W.
    zernike_um : (28,) out
        Coefficients; piston is zero.

    Returns
    -------
    rms_um : float
        RMS residual of W without piston; nan if the fit is singular.
    """
    x, y = samples[:, X] / radius_mm, samples[:, Y] / radius_mm
    first = 1 if use_slopes else 0
    matrix, right = np.zeros((N_TERMS - first, N_TERMS - first)), np.zeros(N_TERMS)
    right = right[first:]
    basis = np.empty((N_TERMS, x.shape[0]))
    px, py = _powers(x, y)
    if use_slopes:
        for d_y in range(2):
            _combine(px, py, 1 - d_y, d_y, basis)
            slopes = samples[:, SLOPE_Y if d_y else SLOPE_X] * radius_mm
            _add_normal_equations(basis, slopes, weights, first, matrix, right)
    _combine(px, py, _NO_DERIVATIVE, _NO_DERIVATIVE, basis)
    residual = samples[:, W].copy()
    if not use_slopes:
        _add_normal_equations(basis, residual, weights, first, matrix, right)
    if not cholesky_solve(matrix, right):
        zernike_um[:] = math.nan
        return math.nan
    zernike_um[0] = 0.0
    for j in range(1, N_TERMS):
        zernike_um[j] = right[j - first]
        _add_scaled(-zernike_um[j], basis[j], residual)
    total = weights.sum()
    residual -= _dot(weights, residual) / total
    _product(residual, residual, basis[0])
    return math.sqrt(_dot(weights, basis[0]) / total)


@njit(cache=True, nogil=True, error_model="numpy")
def _series_peak(mean, even, odd, angle, reach):
    """Return the maximum of a Fourier series within ``reach`` of ``angle``."""
    largest, start = 0.0, angle
    for _ in range(_RIM_STEPS):
        value, slope, bend = mean, 0.0, 0.0
        for k in range(1, even.shape[0]):
            c, s = math.cos(k * angle), math.sin(k * angle)
            value += even[k] * c + odd[k] * s
            slope += k * (odd[k] * c - even[k] * s)
            bend -= k * k * (even[k] * c + odd[k] * s)
        largest = max(largest, value)
        step = -slope / bend if bend < 0.0 else math.copysign(0.25 * reach, slope)
        following = min(max(angle + step, start - reach), start + reach)
        if abs(following - angle) < 1e-9:
            break
        angle = following
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def rim_radius(x, y, is_whole):
    """Return the largest distance (mm) of the rim from the chief ray.

    ``x``, ``y`` (n,) are rim points at equally spaced azimuths of the stop.  The rim of
    an unvignetted pupil is smooth: Newton's method finds the maxima of the Fourier
    series of its squared distance.  A vignetted rim has kinks, so the farthest of its
    points is used.
    """
    n = x.shape[0]
    squared = x * x + y * y
    if not is_whole:
        return math.sqrt(squared.max())
    n_terms = (n - 1) // 2
    even, odd = np.zeros(n_terms + 1), np.zeros(n_terms + 1)
    cosines, sines = np.empty(n), np.empty(n)
    for i in range(n):
        angle = 2.0 * math.pi * i / n
        cosines[i], sines[i] = math.cos(angle), math.sin(angle)
    for k in range(1, n_terms + 1):
        for i in range(n):
            even[k] += 2.0 / n * squared[i] * cosines[(k * i) % n]
            odd[k] += 2.0 / n * squared[i] * sines[(k * i) % n]
    mean, reach, largest = squared.mean(), 2.0 * math.pi / n, squared.max()
    for i in range(n):
        if squared[i] > squared[i - 1] and squared[i] >= squared[(i + 1) % n]:
            peak = _series_peak(mean, even, odd, reach * i, reach)
            largest = max(largest, peak)
    return math.sqrt(largest)


@njit(cache=True, nogil=True, error_model="numpy")
def fit_ellipse(x, y, radius_mm, ellipse):
    """Fit an ellipse, the conic a x² + b xy + c y² + d x + e y = 1, to rim points."""
    matrix, right, row = np.zeros((5, 5)), np.zeros(5), np.empty(5)
    for i in range(x.shape[0]):
        u, v = x[i] / radius_mm, y[i] / radius_mm
        row[0], row[1], row[2], row[3], row[4] = u * u, u * v, v * v, u, v
        _add_row(matrix, row, 1.0)
        for j in range(5):
            right[j] += row[j]
    ellipse[:] = math.nan
    if not cholesky_solve(matrix, right):
        return
    a, b, c, d, e = right[0], right[1], right[2], right[3], right[4]
    determinant = 4.0 * a * c - b * b
    if determinant <= 0.0:
        return
    cx, cy = (b * e - 2.0 * c * d) / determinant, (b * d - 2.0 * a * e) / determinant
    level = 1.0 + a * cx * cx + b * cx * cy + c * cy * cy
    half, spread = 0.5 * (a + c), 0.5 * math.hypot(a - c, b)
    ellipse[CENTER_X], ellipse[CENTER_Y] = cx * radius_mm, cy * radius_mm
    ellipse[SEMI_MAJOR] = radius_mm * math.sqrt(level / (half - spread))
    ellipse[SEMI_MINOR] = radius_mm * math.sqrt(level / (half + spread))
    # The minor axis is along the eigenvector of the larger eigenvalue.
    axis = 0.5 * math.atan2(b, a - c) + 0.5 * math.pi
    ellipse[MAJOR_AXIS_RAD] = axis % math.pi
