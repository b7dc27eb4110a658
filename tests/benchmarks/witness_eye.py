"""Rays through an eye, on Dr.Jit arrays of doubles: the camera of `witness_script`.

Runs in Mitsuba's own environment.  Nothing here comes from the rest of the project: the
eye arrives as numbers, and every formula is written once more.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

NEWTON_STEPS = 5
AIM_STEPS = 12
START_MM = -10.0
"""Rays begin so far before the cornea's apex."""

AIMED_RATIO = 1.25
"""Radius of the disc that rays from the retina aim at, over that of the stop."""


def axes_of(rotation_deg, tilt_deg):
    """Matrix from surface to eye axes: about z first, then x, then y."""
    z, x, y = (math.radians(a) for a in (rotation_deg, *tilt_deg))
    about_z = [
        [math.cos(z), -math.sin(z), 0],
        [math.sin(z), math.cos(z), 0],
        [0, 0, 1],
    ]
    about_x = [
        [1, 0, 0],
        [0, math.cos(x), -math.sin(x)],
        [0, math.sin(x), math.cos(x)],
    ]
    about_y = [
        [math.cos(y), 0, math.sin(y)],
        [0, 1, 0],
        [-math.sin(y), 0, math.cos(y)],
    ]
    return np.array(about_y) @ np.array(about_x) @ np.array(about_z)


def zernike_polynomial(n, m):
    """Coefficients [a, b] of x^a y^b of R_n^|m| cos or sin, without a norm."""
    order = abs(m)
    angular = np.zeros((n + 1, n + 1))
    for k in range(order + 1):  # (x + i y)^order
        part = math.comb(order, k) * 1j**k
        angular[order - k, k] = part.imag if m < 0 else part.real
    found = np.zeros((n + 1, n + 1))
    for s in range((n - order) // 2 + 1):
        weight = (-1) ** s * math.factorial(n - s) / math.factorial(s)
        weight /= math.factorial((n + order) // 2 - s)
        weight /= math.factorial((n - order) // 2 - s)
        squares = (n - order) // 2 - s
        for k in range(squares + 1):  # (x^2 + y^2)^squares
            shift = (2 * (squares - k), 2 * k)
            rolled = np.roll(angular, shift, axis=(0, 1))
            found += weight * math.comb(squares, k) * rolled
    return found


def offset_polynomial(offset_mm, radius_mm):
    """Coefficients (7, 7) of x^a y^b, x and y in mm, of OSA terms 0 to 27."""
    total = np.zeros((7, 7))
    j = 0
    for n in range(7):
        for m in range(-n, n + 1, 2):
            total[: n + 1, : n + 1] += offset_mm[j] * zernike_polynomial(n, m)
            j += 1
    powers = np.arange(7)
    return total / radius_mm ** (powers[:, None] + powers[None, :])


class Sheet:
    """One surface: x^2 cx + y^2 cy over 1 + root, and a polynomial."""

    def __init__(self, given):
        self.curvature = [1.0 / r for r in given["radius_mm"]]
        self.conic = given["conic_constant"]
        self.axes = axes_of(given["rotation_deg"], given["tilt_deg"])
        self.vertex = (*given["decentration_mm"], given["z_mm"])
        self.offset = None
        if given["offset_mm"] is not None:
            self.offset = offset_polynomial(
                given["offset_mm"], given["offset_radius_mm"]
            )

    def _turned(self, vector, axes):
        rows = [
            axes[i, 0] * vector.x + axes[i, 1] * vector.y + axes[i, 2] * vector.z
            for i in range(3)
        ]
        return mi.Vector3d(*rows)

    def sag(self, x, y):
        """Height, and its slopes along x and y."""
        cx, cy = self.curvature
        more = 1.0 + self.conic
        root = dr.sqrt(1.0 - more * (cx * cx * x * x + cy * cy * y * y))
        top, bottom = cx * x * x + cy * y * y, 1.0 + root
        height = top / bottom
        slope = [
            (2.0 * c * along + height * more * c * c * along / root) / bottom
            for c, along in ((cx, x), (cy, y))
        ]
        if self.offset is not None:
            added = self._offset(x, y)
            height, slope = (
                height + added[0],
                [slope[0] + added[1], slope[1] + added[2]],
            )
        return height, *slope

    def _offset(self, x, y):
        value, along_x, along_y = (mi.Float64(0.0) for _ in range(3))
        for b in range(6, -1, -1):  # Horner's rule in y, and in x within
            row, row_slope = mi.Float64(0.0), mi.Float64(0.0)
            for a in range(6 - b, -1, -1):
                row_slope = row_slope * x + row
                row = row * x + float(self.offset[a, b])
            along_y = along_y * y + value
            value = value * y + row
            along_x = along_x * y + row_slope
        return value, along_x, along_y

    def refract(self, point, direction, index_before, index_after):
        """Meet the surface and pass it; indices as the ray travels."""
        vertex = mi.Vector3d(*self.vertex)
        p = self._turned(point - vertex, self.axes.T)
        d = self._turned(direction, self.axes.T)
        t = -p.z / d.z
        for _ in range(NEWTON_STEPS):
            x, y = p.x + t * d.x, p.y + t * d.y
            height, sx, sy = self.sag(x, y)
            t = t - (p.z + t * d.z - height) / (d.z - sx * d.x - sy * d.y)
        met = p + t * d
        _, sx, sy = self.sag(met.x, met.y)
        normal = dr.normalize(mi.Vector3d(-sx, -sy, 1.0))
        normal = dr.select(dr.dot(normal, d) > 0.0, -normal, normal)
        ratio = index_before / index_after
        cosine = -dr.dot(normal, d)
        squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        bent = ratio * d + (ratio * cosine - dr.sqrt(squared)) * normal
        out = self._turned(bent, self.axes)
        return self._turned(met, self.axes) + vertex, dr.normalize(out)


class Eye:
    """Surfaces, stop and retina of one state of an eye."""

    def __init__(self, given):
        self.sheets = [Sheet(surface) for surface in given["surfaces"]]
        self.stop_z_mm = given["stop_z_mm"]
        self.stop_radius_mm = given["stop_radius_mm"]
        self.pupil_z_mm = given["entrance_pupil_z_mm"]
        self.before_stop = sum(
            s["z_mm"] < self.stop_z_mm - 1e-6 for s in given["surfaces"]
        )
        self.retina_radius_mm = given["retina"]["radius_mm"]
        self.retina_conic = given["retina"]["conic_constant"]
        self.retina_z_mm = given["retina"]["z_mm"]

    def inwards(self, point, direction, indices):
        """Where a ray meets the stop's plane, and the retina."""
        for k, sheet in enumerate(self.sheets):
            if k == self.before_stop:
                t = (self.stop_z_mm - point.z) / direction.z
                at_stop = point + t * direction
            point, direction = sheet.refract(
                point, direction, indices[k], indices[k + 1]
            )
        return at_stop, self._on_retina(point, direction)

    def _on_retina(self, point, d):
        p = point - mi.Vector3d(0.0, 0.0, self.retina_z_mm)
        more, radius = 1.0 + self.retina_conic, self.retina_radius_mm
        # x^2 + y^2 + more z^2 + 2 radius z = 0, the far one of both crossings
        a = d.x * d.x + d.y * d.y + more * d.z * d.z
        half_b = p.x * d.x + p.y * d.y + more * p.z * d.z + radius * d.z
        c = p.x * p.x + p.y * p.y + more * p.z * p.z + 2.0 * radius * p.z
        t = (-half_b + dr.sqrt(half_b * half_b - a * c)) / a
        return point + t * d

    def retina_normal(self, at):
        """Towards the inside of the eye."""
        z = at.z - self.retina_z_mm
        along_z = (1.0 + self.retina_conic) * z + self.retina_radius_mm
        return -dr.normalize(mi.Vector3d(at.x, at.y, along_z))

    def chief_rays(self, tangent_x, tangent_y, indices):
        """Where rays of directions in the picture, through the middle of the stop,
        meet the retina.
        """
        direction = -dr.normalize(mi.Vector3d(tangent_x, tangent_y, -1.0))
        x, y = dr.zeros(mi.Float64, dr.width(tangent_x)), 0.0
        for _ in range(AIM_STEPS):
            start = self._start(x, y, direction)
            at_stop, _ = self.inwards(start, direction, indices)
            x, y = x - at_stop.x, y - at_stop.y
            dr.eval(x, y)
        start = self._start(x, y, direction)
        return self.inwards(start, direction, indices)[1]

    def _start(self, x, y, direction):
        through = mi.Vector3d(x, y, self.pupil_z_mm)
        return through + (START_MM - self.pupil_z_mm) / direction.z * direction

    def outwards(self, at, disc_x, disc_y, indices):
        """Rays from the retina through points of the unit disc, and their weight.

        Weight is the projected solid angle that a part of the disc fills at the
        retina: what its light adds to the irradiance there.
        """
        radius_mm = AIMED_RATIO * self.stop_radius_mm
        aimed = mi.Vector3d(radius_mm * disc_x, radius_mm * disc_y, self.stop_z_mm)
        away = aimed - at
        squared = dr.squared_norm(away)
        direction = away / dr.sqrt(squared)
        weight = dr.dot(self.retina_normal(at), direction) * -direction.z / squared
        point, inside = at, mi.Mask(True)
        for k in range(len(self.sheets) - 1, -1, -1):
            point, direction = self.sheets[k].refract(
                point, direction, indices[k + 1], indices[k]
            )
            if k == self.before_stop:
                t = (self.stop_z_mm - point.z) / direction.z
                stop = point + t * direction
                inside = stop.x * stop.x + stop.y * stop.y <= self.stop_radius_mm**2
        return point, direction, dr.select(inside & (weight > 0.0), weight, 0.0)
