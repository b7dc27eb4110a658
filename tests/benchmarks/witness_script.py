"""A scene through an eye's surfaces, in Mitsuba; runs in an environment of its own.

    PYTHON witness_script.py JOB.json OUT.npz

Rays leave the retina where the chief ray of a pixel meets it, pass the eye's surfaces
and go on into the scene, where Mitsuba finds what they meet, its material and what
hides the lamps.  Beside it stands the picture that a pinhole in the entrance pupil
takes, with distances and with what is behind the first thing seen.

Lamps are points and materials are dull, so the only noise is that of the samples.
"""

import json
import sys
import time

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from witness_eye import Eye  # noqa: E402

AMBIENT = 0.6
LAMPS = (((-1.5, 2.2, 0.5), 9.0), ((2.0, 1.5, -1.0), 6.0), ((0.2, 0.9, -2.5), 3.0))
"""Places in metres from the eye, intensities."""

GOLDEN_4D = np.array([0.8566748839, 0.7338918566, 0.6287067210, 0.5385972572])
"""Steps of a sequence of low discrepancy (powers of the root of x^5 = x + 1)."""

PINHOLE_SIDE = 8
"""Rays of the pinhole's picture across a pixel."""

MM_PER_M = 1000.0

SKIPPED = 6
"""Surfaces of the first thing seen that are passed to find what is behind."""


def texture(seed, cells, colors):
    """Dull material with random cells of several sizes, of mixed colours."""
    rng = np.random.default_rng(seed)
    size = 2048
    value = np.zeros((size, size))
    for k, weight in ((cells, 0.5), (4 * cells, 0.3), (16 * cells, 0.2)):
        part = rng.uniform(size=(k, k))
        value += weight * np.kron(part, np.ones((size // k, size // k)))
    value = np.clip((value - 0.25) * 2.0, 0.0, 1.0)[..., None]
    low, high = (np.array(c) for c in colors)
    rgb = (low + (high - low) * value).astype(np.float32)
    return {
        "type": "twosided",
        "material": {
            "type": "diffuse",
            "reflectance": {
                "type": "bitmap",
                "bitmap": mi.Bitmap(rgb),
                "raw": True,
                "filter_type": "bilinear",
            },
        },
    }


def move(x, y, z):
    """Move."""
    return mi.ScalarTransform4f().translate([x, y, z])


def room():
    """Things from 0.35 to 5 m before a wall, seen along -z; metres."""
    turn, scale = mi.ScalarTransform4f().rotate, mi.ScalarTransform4f().scale
    grey = ((0.1,) * 3, (0.9,) * 3)
    warm = ((0.25, 0.08, 0.03), (0.95, 0.75, 0.45))
    cold = ((0.03, 0.08, 0.25), (0.5, 0.75, 0.95))
    leaf = ((0.03, 0.12, 0.03), (0.6, 0.9, 0.35))
    return {
        "wall": {
            "type": "rectangle",
            "to_world": move(0, 0, -5) @ scale([6, 6, 1]),
            "bsdf": texture(1, 64, cold),
        },
        "floor": {
            "type": "rectangle",
            "to_world": move(0, -0.45, -2.5) @ turn([1, 0, 0], -90) @ scale([6, 6, 1]),
            "bsdf": texture(2, 64, grey),
        },
        "box": {
            "type": "cube",
            "to_world": move(0.45, -0.2, -1.3)
            @ turn([0, 1, 0], 30)
            @ scale([0.22, 0.25, 0.22]),
            "bsdf": texture(3, 8, warm),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.42, -0.12, -1.0],
            "radius": 0.2,
            "bsdf": texture(4, 16, leaf),
        },
        "post": {
            "type": "cylinder",
            "p0": [-0.02, -0.45, -0.6],
            "p1": [0.06, 0.5, -0.62],
            "radius": 0.012,
            "bsdf": texture(5, 16, warm),
        },
        "near": {
            "type": "sphere",
            "center": [0.15, -0.1, -0.38],
            "radius": 0.045,
            "bsdf": texture(6, 8, grey),
        },
        "pillar": {
            "type": "cylinder",
            "p0": [-1.1, -0.5, -2.6],
            "p1": [-1.1, 3.0, -2.6],
            "radius": 0.15,
            "bsdf": texture(7, 16, warm),
        },
    }


def plane():
    """One wall at half a metre: nothing hides anything."""
    scale = mi.ScalarTransform4f().scale
    material = texture(1, 64, ((0.05, 0.08, 0.15), (0.95, 0.9, 0.7)))
    return {
        "wall": {
            "type": "rectangle",
            "to_world": move(0, 0, -0.5) @ scale([0.6, 0.6, 1]),
            "bsdf": material,
        }
    }


SCENES = {"room": room, "plane": plane}


def radiance(scene, si):
    """Light (3) that what was met sends back: lamps where nothing hides them."""
    bsdf = si.bsdf()
    towards = mi.Vector3f(0.0, 0.0, dr.sign(si.wi.z))
    albedo = dr.pi * bsdf.eval(mi.BSDFContext(), si, towards)
    light = mi.Float(AMBIENT)
    for place, intensity in LAMPS:
        away = mi.Point3f(*place) - si.p
        squared = dr.squared_norm(away)
        cosine = dr.abs(dr.dot(si.n, away)) * dr.rsqrt(squared)
        # A lamp on the far side of a surface is hidden by the thing itself.
        before = dr.dot(si.n, away) * dr.dot(si.n, si.to_world(si.wi)) > 0.0
        hidden = scene.ray_test(si.spawn_ray_to(mi.Point3f(*place)))
        seen = before & ~hidden
        light += dr.select(seen, intensity * cosine / squared / dr.pi, 0.0)
    return dr.select(si.is_valid(), albedo * light, 0.0)


class Pixels:
    """Pixels of a camera, and values known at their corners."""

    def __init__(self, camera):
        self.width, self.height = camera["width_px"], camera["height_px"]
        self.left, right, self.up, down = camera["tangents"]
        self.across, self.down = right - self.left, down - self.up
        number = dr.arange(mi.UInt32, self.width * self.height)
        self.column, self.row = number % self.width, number // self.width
        self.corners = (self.width + 1) * (self.height + 1)

    def tangents(self, column, row):
        """Of the direction at a place in the picture."""
        x = self.left + self.across * column / self.width
        return x, self.up + self.down * row / self.height

    def corner_tangents(self):
        """At all corners, in doubles."""
        number = dr.arange(mi.UInt32, self.corners)
        side = self.width + 1
        return self.tangents(mi.Float64(number % side), mi.Float64(number // side))

    def between(self, values, u, v):
        """Values (3) at places within the pixels, of those at the corners."""

        def at(dx, dy):
            number = self.column + dx + (self.row + dy) * (self.width + 1)
            return dr.gather(mi.Vector3d, values, number)

        top = at(0, 0) + u * (at(1, 0) - at(0, 0))
        bottom = at(0, 1) + u * (at(1, 1) - at(0, 1))
        return top + v * (bottom - top)

    def image(self, values):
        """Array (height, width, ...)."""
        array = np.array(values)
        return array.reshape(*array.shape[:-1], self.height, self.width)


def shot(scene, pixels, u, v):
    """What rays through places within the pixels meet, and what is behind it."""
    x, y = pixels.tangents(mi.Float(pixels.column) + u, mi.Float(pixels.row) + v)
    ray = mi.Ray3f(mi.Point3f(0.0), dr.normalize(mi.Vector3f(x, y, -1.0)))
    first = scene.ray_intersect(ray)
    behind, seen = scene.ray_intersect(first.spawn_ray(ray.d)), first.shape
    for _ in range(SKIPPED):
        again = behind.is_valid() & (behind.shape == seen)
        farther = scene.ray_intersect(behind.spawn_ray(ray.d), again)
        behind = dr.select(again, farther, behind)
    return first, behind


def pinhole(scene, pixels):
    """Color, distance, and both of what is behind, as arrays."""
    count = pixels.width * pixels.height
    colors = [dr.zeros(mi.Color3f, count) for _ in range(2)]
    hits = [dr.zeros(mi.Float, count) for _ in range(2)]
    offsets = (np.arange(PINHOLE_SIDE) + 0.5) / PINHOLE_SIDE
    for v in offsets:
        for u in offsets:
            places = (dr.opaque(mi.Float, u), dr.opaque(mi.Float, v))
            for k, si in enumerate(shot(scene, pixels, *places)):
                colors[k] += radiance(scene, si)
                hits[k] += dr.select(si.is_valid(), 1.0, 0.0)
            dr.eval(colors, hits)
    found = {}
    middle = shot(scene, pixels, mi.Float(0.5), mi.Float(0.5))
    for k, (name, si) in enumerate(zip(("", "hidden_"), middle, strict=True)):
        mean = colors[k] / dr.maximum(hits[k], 1.0)
        distance = dr.select(si.is_valid(), dr.norm(si.p), 0.0)
        found[name + "color"] = np.moveaxis(pixels.image(mean), 0, -1)
        found[name + "depth_m"] = pixels.image(distance)
    return found


def through_eye(scene, pixels, eye, indices, places, samples):
    """Pictures (height, width, 3) on the retina by directions of chief rays.

    The first is of all samples, the second of the first half of them.
    """
    count = pixels.width * pixels.height
    rng = np.random.default_rng(5)
    shifts = [mi.Float64(rng.uniform(size=count)) for _ in range(4)]
    origin = mi.Vector3d(0.0, 0.0, eye.pupil_z_mm)

    def sample(k, channel):
        u, v, p, q = (s + float(g) * k for s, g in zip(shifts, GOLDEN_4D, strict=True))
        u, v, p, q = (x - dr.floor(x) for x in (u, v, p, q))
        radius, angle = dr.sqrt(p), 2.0 * dr.pi * q
        start, direction, weight = eye.outwards(
            pixels.between(places, u, v),
            radius * dr.cos(angle),
            radius * dr.sin(angle),
            indices[channel],
        )
        start_m = mi.Point3f((start - origin) / MM_PER_M)
        passes = mi.Mask(weight > 0.0)
        si = scene.ray_intersect(mi.Ray3f(start_m, mi.Vector3f(direction)), passes)
        light = dr.select(passes, radiance(scene, si)[channel], 0.0)
        return mi.Float64(light) * weight, weight

    pictures = np.zeros((2, pixels.height, pixels.width, 3))
    for channel in range(3):
        total, weights = (dr.zeros(mi.Float64, count) for _ in range(2))
        for k in range(samples):
            light, weight = sample(dr.opaque(mi.Float64, float(k)), channel)
            total += light
            weights += weight
            dr.eval(total, weights)
            if k + 1 in (samples // 2, samples):
                mean = pixels.image(total / weights)
                pictures[int(k + 1 < samples), ..., channel] = mean
    return pictures


def main():
    """Do the job of a file."""
    with open(sys.argv[1], encoding="utf-8") as file:
        job = json.load(file)
    scene = mi.load_dict({"type": "scene", **SCENES[job["scene"]]()})
    pixels, given = Pixels(job["camera"]), job["eye"]
    eye = Eye(given)
    places = eye.chief_rays(*pixels.corner_tangents(), given["reference_indices"])
    dr.eval(places)
    found = pinhole(scene, pixels)
    start_s = time.perf_counter()
    found["seen"], found["seen_by_half"] = through_eye(
        scene, pixels, eye, given["channel_indices"], places, job["samples"]
    )
    found["seconds"] = time.perf_counter() - start_s
    np.savez(sys.argv[2], version=mi.__version__, **found)


if __name__ == "__main__":
    main()
