"""Compiled inner loops of ray optics: footprints of pupil cells, and edge diffraction.

They release the GIL and are single-threaded, like those of `fourier_kernels`.
"""

import math

import numpy as np
from numba import njit

from estimator.psf.kernel_types import finish_kernel
from estimator.psf.tail import add_tail

MIN_CELLS = 32
MAX_CELLS = 192
"""Cells across the pupil; more than 192 have no visible effect."""

CELLS_PER_PX = 1.2
"""Cells per pixel of blur: footprints are then at most about a pixel wide."""

MIN_EDGE_POINTS = 64
EDGE_POINTS_PER_PX = 3.0
POINTS_AT_ONCE = 8
"""The number of edge points is a multiple of this."""

NEAR_PX = 2
FAR_PX = 6
"""Distances from the image of the edge within which its light is sampled at steps of
half a pixel and of one pixel; farther out, its mean is used (see `tail`)."""

MIN_CURVATURE_RATIO = 0.1
"""Ratio to the curvature of the wavefront below which the curvature along the edge
counts as zero: the image of the edge has a cusp there, where the straight-edge
approximation fails."""


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _row_footprints(row, x, cell, factor_x, factor_y, boxes):
    """Compute left and lower ends (px), sizes and inverse sizes of a row of footprints.

    ``row`` (3, 7) float32 are the polynomials in x of W, dW/dy and d²W/dy² at this row.
    A footprint is the box with the same variance as the image of the cell, a
    parallelogram.
    """
    # Scalars are loaded first: inside the loop, they might alias its outputs, and the
    # loop would not vectorize.
    two, three, four, five = np.float32(2), np.float32(3), np.float32(4), np.float32(5)
    c, d, e = row[0], row[1], row[2]
    c1, c2, c3, c4 = c[1], two * c[2], three * c[3], four * c[4]
    c5, c6 = five * c[5], np.float32(6) * c[6]
    d0, d1, d2, d3, d4, d5 = d[0], d[1], d[2], d[3], d[4], d[5]
    e0, e1, e2, e3, e4 = e[0], e[1], e[2], e[3], e[4]
    half, one, tiny = np.float32(0.5), np.float32(1), np.float32(1e-12)
    cell_x, cell_y = cell * factor_x, cell * factor_y
    left, low, wide, high = boxes[0], boxes[1], boxes[2], boxes[3]
    per_wide, per_high = boxes[4], boxes[5]
    for i in range(x.shape[0]):
        u = x[i]
        sx = c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * c6))))
        sy = d0 + u * (d1 + u * (d2 + u * (d3 + u * (d4 + u * d5))))
        hxx = c2 + u * (two * c3 + u * (three * c4 + u * (four * c5 + u * five * c6)))
        hxy = d1 + u * (two * d2 + u * (three * d3 + u * (four * d4 + u * five * d5)))
        hyy = e0 + u * (e1 + u * (e2 + u * (e3 + u * e4)))
        wx = cell_x * np.sqrt(hxx * hxx + hxy * hxy)
        wy = cell_y * np.sqrt(hxy * hxy + hyy * hyy)
        left[i], low[i] = factor_x * sx - half * wx, factor_y * sy - half * wy
        wide[i], high[i] = wx, wy
        per_wide[i], per_high[i] = one / (wx + tiny), one / (wy + tiny)


@njit(cache=True, nogil=True, error_model="numpy")
def _splat_wide_box(image, box, weight):
    """Distribute a weight over the pixels that a box covers, by area."""
    x0, x1, y0, y1 = box
    radius = image.shape[0] // 2
    per_area = weight / ((x1 - x0) * (y1 - y0))
    iy0, iy1 = math.floor(y0 + 0.5), math.floor(y1 + 0.5)
    ix0, ix1 = math.floor(x0 + 0.5), math.floor(x1 + 0.5)
    for iy in range(max(iy0, -radius), min(iy1, radius) + 1):
        part = per_area * (min(y1, iy + 0.5) - max(y0, iy - 0.5))
        for ix in range(max(ix0, -radius), min(ix1, radius) + 1):
            share = min(x1, ix + 0.5) - max(x0, ix - 0.5)
            image[radius - iy, ix + radius] += part * share


@njit(cache=True, nogil=True)
def _three_shares(over, per_width):
    """Return the shares of three pixels; ``over`` is the box's part past the first."""
    one, zero = np.float32(1.0), np.float32(0.0)
    last = max(over - one, zero) * per_width
    middle = min(max(over, zero), one) * per_width
    return one - middle - last, middle, last


@njit(cache=True, nogil=True)
def _splat_boxes(image, boxes, first, end, weights):
    """Distribute weights over the pixels that boxes cover, by area.

    Most boxes span at most two pixels per axis, which is the fast path.
    """
    radius = image.shape[0] // 2
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    zero = np.float32(0.0)
    left, low, wide, high = boxes[0], boxes[1], boxes[2], boxes[3]
    per_wide, per_high = boxes[4], boxes[5]
    for i in range(first, end):
        x0, y0, width, height = left[i], low[i], wide[i], high[i]
        ix, iy = math.floor(x0 + half), math.floor(y0 + half)
        over_x = x0 + width - np.float32(ix) - half
        over_y = y0 + height - np.float32(iy) - half
        is_inside = -radius <= ix < radius - 1 and -radius <= iy < radius - 1
        if not is_inside or over_x > two or over_y > two:
            # A box of size zero in the last pixel would divide by zero.
            tiny = 1e-9
            box = (x0, x0 + width + tiny, y0, y0 + height + tiny)
            _splat_wide_box(image, box, weights[i])
            continue
        row, column = radius - iy, radius + ix
        if over_x > one or over_y > one:
            y_shares = _three_shares(over_y, per_high[i])
            x_shares = _three_shares(over_x, per_wide[i])
            for j in range(3):
                part = weights[i] * y_shares[j]
                image[row - j, column] += part * x_shares[0]
                image[row - j, column + 1] += part * x_shares[1]
                image[row - j, column + 2] += part * x_shares[2]
            continue
        # All four pixels are written, some with weight 0, which is faster than
        # unpredictable branches.
        share_x = max(over_x, zero) * per_wide[i]
        share_y = max(over_y, zero) * per_high[i]
        upper = weights[i] * share_y
        lower = weights[i] - upper
        image[row, column] += lower * (one - share_x)
        image[row, column + 1] += lower * share_x
        image[row - 1, column] += upper * (one - share_x)
        image[row - 1, column + 1] += upper * share_x


@njit(cache=True, nogil=True)
def _row_coefficients(polynomial, y, row):
    """Compute the polynomials (3, 7) in x of W, dW/dy and d²W/dy² at one y."""
    for a in range(7):
        value, first, second = 0.0, 0.0, 0.0
        for b in range(6 - a, -1, -1):
            second = second * y + 2.0 * first
            first = first * y + value
            value = value * y + polynomial[b, a]
        row[0, a], row[1, a], row[2, a] = value, first, second


@njit(cache=True, nogil=True, error_model="numpy")
def splat_pupil(polynomial, half, shear, log_amplitude, n_cells, image):
    """Add the footprints of the pupil's cells to an image; return their total weight.

    Parameters
    ----------
    polynomial : (7, 7), um
        ``[b, a]`` is the coefficient of y^b x^a of W over the bounding box.
    half, shear, log_amplitude : (2,), float, (6,)
        See `psf.pupil.PupilFrames`.
    n_cells : int
        Cells across the bounding box.
    image : (2R+1, 2R+1) float32, updated
        In image orientation.
    """
    cell = 2.0 / n_cells
    x = ((np.arange(n_cells) + 0.5) * cell - 1.0).astype(np.float32)
    boxes, weights = np.empty((6, n_cells), np.float32), np.empty(n_cells, np.float32)
    row = np.empty((3, 7), np.float32)
    s2 = 1.0 - shear * shear
    is_apodized = False
    for c in log_amplitude:
        is_apodized = is_apodized or c != 0.0
    # Cells within this radius are inside the ellipse, even at its minor axis.
    inner = max(0.0, 1.0 - 0.75 * cell / math.sqrt(1.0 - abs(shear)))
    total = 0.0
    for j in range(n_cells):
        y = (j + 0.5) * cell - 1.0
        _row_coefficients(polynomial, y, row)
        reach = math.sqrt(max(0.0, (1.0 + 0.5 * cell) ** 2 - y * y) * s2) + cell
        first = max(0, math.floor((1.0 + shear * y - reach) / cell))
        end = min(n_cells, math.ceil((1.0 + shear * y + reach) / cell))
        core = math.sqrt(max(0.0, inner * inner - y * y) * s2)
        core_first = math.ceil((1.0 + shear * y - core) / cell)
        core_end = math.floor((1.0 + shear * y + core) / cell)
        for i in range(first, end):
            weights[i] = 1.0
            if core_first <= i < core_end:
                continue
            # Area of the cell inside the ellipse, whose edge is taken as straight.
            slope_x, slope_y = x[i] - shear * y, y - shear * x[i]
            r = math.sqrt((x[i] * slope_x + y * slope_y) / s2)
            steep = math.sqrt(slope_x * slope_x + slope_y * slope_y)
            depth = (1.0 - r) * r * s2 / max(steep, 1e-9)
            weights[i] = min(1.0, max(0.0, depth / cell + 0.5))
        if is_apodized:
            _apodize(x, y, log_amplitude, first, end, weights)
        for i in range(first, end):
            total += weights[i]
        factors = np.float32(1.0 / half[0]), np.float32(1.0 / half[1])
        part = x[first:end]
        _row_footprints(row, part, np.float32(cell), factors[0], factors[1], boxes)
        _splat_boxes(image, boxes, 0, end - first, weights[first:end])
    return total


@njit(cache=True, nogil=True)
def _apodize(x, y, log_amplitude, first, end, weights):
    c0, c1, c2, c3, c4, c5 = log_amplitude
    for i in range(first, end):
        exponent = c0 + x[i] * (c1 + c3 * x[i] + c4 * y) + y * (c2 + c5 * y)
        weights[i] *= math.exp(2.0 * exponent)


@njit(cache=True, nogil=True, error_model="numpy")
def _fresnel(v, table, limit):
    """Return the integral up to v of straight-edge diffraction minus the shadow."""
    if abs(v) >= limit:
        return -1.0 / (2.0 * math.pi**2 * v)
    place = (v + limit) / (2.0 * limit) * (table.size - 1)
    i = min(int(place), table.size - 2)
    return table[i] + (place - i) * (table[i + 1] - table[i])


@njit(cache=True, nogil=True)
def _deposit(image, x, y, per_width, light):
    """Distribute light over the pixels, up to four, under a small box at (x, y)."""
    radius = image.shape[0] // 2
    ix, iy = math.floor(x), math.floor(y)
    if ix < -radius or iy < -radius or ix >= radius or iy >= radius:
        return
    right = min(1.0, max(0.0, (x - ix - 0.5) * per_width + 0.5))
    up = min(1.0, max(0.0, (y - iy - 0.5) * per_width + 0.5))
    row, column = radius - iy, radius + ix
    upper = light * up
    lower = light - upper
    image[row, column] += lower * (1.0 - right)
    image[row, column + 1] += lower * right
    image[row - 1, column] += upper * (1.0 - right)
    image[row - 1, column + 1] += upper * right


@njit(cache=True, nogil=True, error_model="numpy")
def _point_on_edge(polynomial, x, y, half, row):
    """Return slopes (px) and second derivatives (px²/um) of W at a point of the box."""
    _row_coefficients(polynomial, y, row)
    sx, sy, hxx, hxy, hyy = 0.0, 0.0, 0.0, 0.0, 0.0
    value = 0.0
    for a in range(6, -1, -1):
        hxx = hxx * x + 2.0 * sx
        sx = sx * x + value
        value = value * x + row[0, a]
        hxy = hxy * x + sy
        sy = sy * x + row[1, a]
        hyy = hyy * x + row[2, a]
    ax, ay = half
    return sx / ax, sy / ay, hxx / (ax * ax), hxy / (ax * ay), hyy / (ay * ay)


@njit(cache=True, nogil=True, error_model="numpy")
def _deposit_profile(image, start, normal, strength, v_per_px, fresnel):
    """Add the diffracted light of an edge point along the normal of the edge.

    Near the edge, steps are half a pixel, one of them centered on the edge: for a flat
    wavefront, the profile has a pole there, whose two sides cancel.
    """
    table, limit = fresnel
    near_end, end = NEAR_PX + 0.25, FAR_PX + 0.25
    b = -end
    before = _fresnel(b * v_per_px, table, limit)
    while b < end - 0.1:
        is_near = -near_end <= b < near_end - 0.1
        step = 0.5 if is_near else 1.0
        after = _fresnel((b + step) * v_per_px, table, limit)
        d = b + 0.5 * step
        x, y = start[0] + d * normal[0], start[1] + d * normal[1]
        _deposit(image, x, y, 2.0 if is_near else 1.0, strength * (after - before))
        before = after
        b += step


@njit(cache=True, nogil=True, error_model="numpy")
def add_edge_light(
    polynomial, half, shear, log_amplitude, passed, wave, extent_px, image
):
    """Add diffraction at the edge of the pupil to a ray-optical spot.

    Parameters
    ----------
    polynomial, half, shear, log_amplitude
        See `splat_pupil`.
    passed : float
        Transmission of the apodized pupil.
    wave : (wavelength_um, table, limit)
        Wavelength, and the table of `geometric.fresnel_table`.
    extent_px : float
        Larger side of the spot.
    image : (2R+1, 2R+1) float32, updated
        In shares of the light.

    Notes
    -----
    An edge element ds with slope s and outward normal n (in t, see `pupil`) sends its
    light along p = s + d n.  The curvature of the wavefront across the edge is
    k = H_nn - H_nt²/H_tt, for second derivatives H, so that d = k q at a depth q.  The
    irradiance is that of straight-edge diffraction at
    v = -sign(k) d sqrt(2 / (lambda |k|)).  The light of its difference from the
    geometric shadow is ds/A sqrt(lambda / (2 |k|)) times the integral over v.  For
    k -> 0, and far outside, it is the mean edge light of `survey.needed_radius_px`.
    """
    wavelength_um, table, limit = wave
    n_points = max(MIN_EDGE_POINTS, EDGE_POINTS_PER_PX * extent_px)
    n_points = POINTS_AT_ONCE * math.ceil(n_points / POINTS_AT_ONCE)
    row = np.empty((3, 7), np.float32)
    s = math.sqrt(1.0 - shear * shear)
    c0, c1, c2, c3, c4, c5 = log_amplitude
    for i in range(n_points):
        angle = 2.0 * math.pi * (i + 0.5) / n_points
        wx, wy = math.cos(angle), math.sin(angle)
        x, y = wx, shear * wx + s * wy
        nx, ny = (wx - shear / s * wy) / half[0], wy / s / half[1]
        length = math.sqrt(nx * nx + ny * ny)
        nx, ny = nx / length, ny / length
        sx, sy, hxx, hxy, hyy = _point_on_edge(polynomial, x, y, half, row)
        across = hxx * nx * nx + 2.0 * hxy * nx * ny + hyy * ny * ny
        along = hxx * ny * ny - 2.0 * hxy * nx * ny + hyy * nx * nx
        mixed = (hyy - hxx) * nx * ny + hxy * (nx * nx - ny * ny)
        least = MIN_CURVATURE_RATIO * (abs(across) + abs(along) + abs(mixed)) + 1e-12
        curvature = across - mixed * mixed * along / (along * along + least * least)
        size = max(abs(curvature), 1e-6)
        v_per_px = math.copysign(math.sqrt(2.0 / (wavelength_um * size)), -curvature)
        share = 2.0 * length / n_points / passed
        share *= math.exp(2.0 * (c0 + x * (c1 + c3 * x + c4 * y) + y * (c2 + c5 * y)))
        strength = share * math.sqrt(wavelength_um / (2.0 * size))
        strength = math.copysign(strength, v_per_px)
        _deposit_profile(image, (sx, sy), (nx, ny), strength, v_per_px, (table, limit))


@njit(cache=True, nogil=True)
def trace_batch(frames, power_x, power_y, survey, wave, output):
    """Compute ray-optical kernels and add them to the output buffer.

    Parameters
    ----------
    frames : (polynomial (B, 28) um, half (B, 2), shear (B,), log_amplitude (B, 6),
        passed (B,))
    power_x, power_y : (28,) int64
    survey : (edge_slope_px (B, n, 2), edge_um (B,), extent_px (B,))
        The last is the larger side of the spot.
    wave : (wavelength_um (B,), table, limit, is_diffracting)
    output : (flat float32, offset (B,), radius_px (B,), share (B,), total (B,))
        Kernels are scaled to a sum of ``share`` and added; ``total`` is written.
    """
    polynomial, half, shear, log_amplitude, passed = frames
    wavelength_um, table, limit, is_diffracting = wave
    flat, offset, radius_px, share, total = output
    edge, edge_um, extent_px = survey
    nowhere = np.array([1, 0, 1, 0])
    dense = np.zeros((7, 7))
    for b in range(polynomial.shape[0]):
        for j in range(polynomial.shape[1]):
            dense[power_y[j], power_x[j]] = polynomial[b, j]
        radius = radius_px[b]
        side = 2 * radius + 1
        image = np.zeros((side, side), np.float32)
        s = math.sqrt(1.0 - shear[b] * shear[b])
        n_cells = math.ceil(max(MIN_CELLS / s, CELLS_PER_PX * extent_px[b]))
        weight = splat_pupil(
            dense,
            half[b],
            shear[b],
            log_amplitude[b],
            min(MAX_CELLS, n_cells),
            image,
        )
        scale = np.float32(1.0 / weight)
        for row in range(side):
            for column in range(side):
                image[row, column] *= scale
        if is_diffracting:
            add_edge_light(
                dense,
                half[b],
                shear[b],
                log_amplitude[b],
                passed[b],
                (wavelength_um[b], table, limit),
                extent_px[b],
                image,
            )
            # Beside a caustic, fringes of the edge can exceed the light of the rays, so
            # negative values are clamped.
            for row in range(side):
                for column in range(side):
                    image[row, column] = max(image[row, column], np.float32(0.0))
            add_tail(
                image, nowhere, float(FAR_PX), edge[b], half[b], shear[b], edge_um[b]
            )
        total[b] = finish_kernel(
            image, share[b], flat[offset[b] : offset[b] + side * side]
        )
