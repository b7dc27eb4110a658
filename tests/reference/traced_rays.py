"""Twin of the ray tracer in C: rays through all forms and gradients, one at a time.

In a gradient, SciPy's DOP853 integrates d/ds(n dr/ds) = grad n with rtol 1e-12;
surfaces are events, where rays are refracted by Snell's law.  This file repeats the
formulas of sags and indices and shares no code with the tracer; slopes come from
complex steps, exact to rounding.
"""

import math

import numpy as np
from scipy.integrate import solve_ivp

from estimator.optics.forms import EvenAsphere, SeparateProfiles, Toroid, TwoConics
from estimator.optics.gradients import (
    GoncharovDaintyGradient,
    PolynomialGradient,
    SquaredPolynomialGradient,
)
from estimator.optics.media import refractive_index
from estimator.optics.surfaces import Retina, Surface, rotation_matrix
from estimator.optics.zernike import nm_from_index

_STEP = 1e-30


def _axes(surface):
    return rotation_matrix(rotation_deg=surface.rotation_deg, tilt_deg=surface.tilt_deg)


def _origin(surface):
    return np.array([*surface.decentration_mm, surface.z_mm])


def sag_mm(surface, x, y):
    """Sag of a surface or retina in its own axes; x and y may be complex."""
    rx, ry = np.broadcast_to(np.asarray(surface.radius_mm, float), (2,))
    if isinstance(surface, Retina):
        rx, ry = -abs(rx), -abs(ry)
    kx = ky = surface.conic_constant
    if isinstance(surface.form, (TwoConics, SeparateProfiles)):
        kx, ky = surface.form.conic_constants
    if isinstance(surface.form, Toroid):
        near = rx - _profile(y, ry, ky)
        total = rx - np.sign(rx) * np.sqrt(near**2 - x**2)
    elif isinstance(surface.form, SeparateProfiles):
        total = _profile(x, rx, kx) + _profile(y, ry, ky)
    else:
        radicand = 1.0 - (1.0 + kx) * x**2 / rx**2 - (1.0 + ky) * y**2 / ry**2
        # Steps of an integration may leave the surface's domain; no result does.
        root = np.sqrt(radicand) if np.real(radicand) > 0.0 else 0.0
        total = (x**2 / rx + y**2 / ry) / (1.0 + root)
    if isinstance(surface.form, EvenAsphere):
        r2 = x**2 + y**2
        for power, coefficient in enumerate(surface.form.coefficients, start=1):
            total = total + coefficient * r2**power
    if isinstance(surface, Surface) and surface.offset_mm is not None:
        rho = surface.offset_radius_mm
        total = total + _offset(surface.offset_mm, x / rho, y / rho)
    return total


def _profile(x, radius, conic):
    return x**2 / radius / (1.0 + np.sqrt(1.0 - (1.0 + conic) * x**2 / radius**2))


def _offset(terms, x, y):
    """Sum of unnormalized Zernike terms, OSA order."""
    total = 0.0
    for j in np.flatnonzero(terms):
        n, m = nm_from_index(j)
        powers = [
            (-1) ** k
            * math.comb(n - k, k)
            * math.comb(n - 2 * k, (n - abs(m)) // 2 - k)
            * (x**2 + y**2) ** ((n - abs(m)) // 2 - k)
            for k in range((n - abs(m)) // 2 + 1)
        ]
        turns = _solid_harmonic(x, y, abs(m))[0 if m >= 0 else 1]
        total = total + terms[j] * sum(powers) * turns
    return total


def _solid_harmonic(x, y, m):
    """r^m cos(m t) and r^m sin(m t), which may be complex."""
    real, imaginary = 1.0, 0.0
    for _ in range(m):
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    return real, imaginary


def _normal(surface, x, y):
    slope_x = sag_mm(surface, x + 1j * _STEP, y).imag / _STEP
    slope_y = sag_mm(surface, x, y + 1j * _STEP).imag / _STEP
    normal = np.array([-slope_x, -slope_y, 1.0])
    return normal / np.linalg.norm(normal)


def _gradient_index(medium, x, y, z, wavelength_nm):
    r2 = x**2 + y**2
    if isinstance(medium, GoncharovDaintyGradient):
        n0, n1, n2, n3, n4, n5, n6 = medium.coefficients
        value = n0 + n1 * r2 + n2 * r2**2 + n3 * z + n4 * z**2 + n5 * z**3 + n6 * z**4
    else:
        value = sum(
            c * r2**i * z**j
            for i, row in enumerate(medium.coefficients)
            for j, c in enumerate(row)
        )
    if isinstance(medium, SquaredPolynomialGradient):
        return value**0.5
    if medium.dispersion is not None:
        value = value + float(
            medium.dispersion.refractive_index(wavelength_nm)
            - medium.dispersion.refractive_index(medium.reference_wavelength_nm)
        )
    return value


class _Medium:
    """The medium behind surface ``i`` (-1: air)."""

    def __init__(self, eye, i, wavelength_nm):
        name = "air" if i < 0 else eye.surfaces[i].medium_after
        found = (eye.media or {}).get(name)
        self.gradient = isinstance(
            found,
            (PolynomialGradient, SquaredPolynomialGradient, GoncharovDaintyGradient),
        )
        if self.gradient:
            self.medium, self.nm = found, wavelength_nm
            self.axes, self.origin = _axes(eye.surfaces[i]), _origin(eye.surfaces[i])
        else:
            self.constant = float(
                refractive_index(
                    name, wavelength_nm, indices=eye.indices, media=eye.media
                )
            )

    def index(self, point):
        if not self.gradient:
            return self.constant
        return _gradient_index(
            self.medium, *((point - self.origin) @ self.axes), self.nm
        )

    def rate(self, _, y):
        local = (y[:3] - self.origin) @ self.axes
        n = _gradient_index(self.medium, *local, self.nm)
        slope = np.empty(3)
        for k in range(3):
            at = local.astype(complex)
            at[k] += 1j * _STEP
            slope[k] = _gradient_index(self.medium, *at, self.nm).imag / _STEP
        return np.concatenate([y[3:6] / n, self.axes @ slope, [n]])


def _to_surface(surface, medium, point, direction):
    """Point on the surface, direction there and optical path."""
    axes, origin = _axes(surface), _origin(surface)

    def height(_, y):
        x, v, z = (y[:3] - origin) @ axes
        return z - sag_mm(surface, x, v)

    height.terminal = True
    if medium.gradient:
        n = medium.index(point)
        # A first step off the surface behind the ray, which may be its own event.
        start = np.concatenate([point, n * direction, [0.0]])
        found = solve_ivp(
            medium.rate,
            (0.0, 40.0),
            start,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
            events=height,
        )
        assert found.t_events[0].size, "the ray misses the surface"
        end = found.y_events[0][0]
        # The event is found on the interpolant; a short straight Newton step ends it.
        n = medium.index(end[:3])
        point, direction, path = end[:3], end[3:6] / n, end[6]
    else:
        n, path = medium.constant, 0.0
        nearer_mm = 3.0 if isinstance(surface, Retina) else 0.0
        t = (origin[2] - nearer_mm - point[2]) / direction[2]
        point, path = point + t * direction, n * t
    for _ in range(50):
        local, slope = (point - origin) @ axes, direction @ axes
        normal = _normal(surface, local[0], local[1])
        miss = (local[2] - sag_mm(surface, local[0], local[1])) * normal[2]
        t = -miss / (normal @ slope)
        point, path = point + t * direction, path + medium.index(point) * t
        if abs(t) < 1e-14:
            break
    else:
        raise AssertionError("the ray misses the surface")
    return point, direction, path


def _refracted(surface, direction, point, n_from, n_to):
    axes, origin = _axes(surface), _origin(surface)
    local = (point - origin) @ axes
    normal = axes @ _normal(surface, local[0], local[1])
    cosine = normal @ direction
    if cosine < 0.0:
        normal, cosine = -normal, -cosine
    ratio = n_from / n_to
    squared = 1.0 - ratio**2 * (1.0 - cosine**2)
    assert squared >= 0.0, "total reflection"
    return ratio * direction + (math.sqrt(squared) - ratio * cosine) * normal


def trace(eye, start, direction, wavelength_nm, *, reverse=False):
    """Points and paths at the surfaces, stop excluded, in the order of travel.

    Also the last direction.  Forward rays end on the retina, reverse rays in air behind
    the first surface.
    """
    point = np.asarray(start, float)
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    count, path = len(eye.surfaces), 0.0
    media = [_Medium(eye, i, wavelength_nm) for i in range(-1, count)]
    points, paths = [], []
    order = range(count - 1, -1, -1) if reverse else range(count)
    for i in order:
        before, behind = (
            (media[i + 1], media[i]) if reverse else (media[i], media[i + 1])
        )
        surface = eye.surfaces[i]
        point, direction, more = _to_surface(surface, before, point, direction)
        path += more
        points.append(point)
        paths.append(path)
        direction = _refracted(
            surface, direction, point, before.index(point), behind.index(point)
        )
    if not reverse:
        point, direction, more = _to_surface(eye.retina, media[-1], point, direction)
        points.append(point)
        paths.append(path + more)
    return np.array(points), np.array(paths), direction
