"""Synthetic views, stores and figures of merit for the tests of the renderer."""

import math

import numpy as np
from scipy.ndimage import zoom

from estimator.profiles.parse import parse_profile
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.frame import MODE_TOLERANCE_RATIO
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.numerical.plan_twin import layer_blur_px

AS_DYNAMIC = 1.0 / MODE_TOLERANCE_RATIO["on-axis"]
"""Tolerance at which frames on the axis merge as in the mode "dynamic"."""


def tangents(width_px, height_px, vertical_fov_deg):
    up = math.tan(math.radians(vertical_fov_deg) / 2)
    right = up * width_px / height_px
    return -right, right, up, -up


def texture(rng, height_px, width_px, cell_px=4):
    """Smoothly varying colored noise in 0..1, float32 linear."""
    coarse = rng.random((height_px // cell_px + 2, width_px // cell_px + 2, 3))
    fine = zoom(coarse, (cell_px, cell_px, 1), order=1)[:height_px, :width_px]
    return np.clip(fine, 0.0, 1.0).astype(np.float32)


def depth_scene():
    """Depth (101, 150): near disc, slanted floor and far wall; edges, slopes, flats."""
    y, x = np.mgrid[0:101, 0:150]
    floor = 1.0 / (0.1 + 1.5 * np.clip(y - 60, 0, None) / 40)
    depth_m = np.where(y > 60, floor, 8.0)
    disc = (x - 60) ** 2 + (y - 40) ** 2 < 20**2
    return np.where(disc, 0.4, depth_m).astype(np.float32)


def psnr_db(image, reference):
    """Linear light, peak 1, mean over channels."""
    error = np.mean((np.asarray(image, float) - reference) ** 2)
    return -10.0 * math.log10(max(float(error), 1e-30))


class Bench:
    """One camera and eye, ready to render."""

    def __init__(
        self, engine, profile, *, width_px, height_px, vertical_fov_deg, **spec
    ):
        self.width_px, self.height_px = width_px, height_px
        self.tangents = tangents(width_px, height_px, vertical_fov_deg)
        self.spec = grid_spec(
            width_px=width_px, height_px=height_px, tangents=self.tangents, **spec
        )
        self.store = build_psf_store(parse_profile(profile), self.spec)
        self.gpu = engine.gpu
        self.renderer = engine.new_renderer()
        self.handle = self.renderer.load(self.store)

    def view(self, color, depth_m, depth_kind="planar"):
        depth_m = np.broadcast_to(
            np.float32(depth_m), (self.height_px, self.width_px)
        ).astype(np.float32)
        return RgbdView(color, depth_m, self.tangents, depth_kind)

    def render(self, view, **options):
        options = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.0, **options}
        return self.renderer.render(view, self.handle, **options)

    def layers(self, **options):
        options = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.0, **options}
        return frame_layers(self.store, State(**options))

    def blur_px(self, **options):
        """Blur radius (n_layers, 3) of a frame's layers, on axis."""
        layers = self.layers(**options)
        state = layers.reads, layers.layer_zero_dpt[:1], layers.layer_dpt
        return layer_blur_px(self.store, *state)


MAX_ROUNDED_SHARE = 1e-3
"""Of the bytes of a frame that a driver computes: those that may round otherwise."""


def is_same_frame(found, expected, *, is_exact=False):
    """Whether two images hold the same frame.

    What the native engine computes is equal to the byte (``is_exact``).  OpenGL leaves
    the rounding of divisions, roots and fused products to the driver, and llvmpipe's
    depends on the processor: a sum that lies at the edge between two bytes may fall on
    either side in another program.  Of a thousand bytes one may differ, by one step;
    half floats by two units in the last place, floats by 1e-5 of white.
    """
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if is_exact or np.array_equal(found, expected):
        return bool(np.array_equal(found, expected))
    if found.dtype == np.uint8:
        steps = np.abs(found.astype(int) - expected.astype(int))
        return bool(steps.max() <= 1 and np.mean(steps > 0) <= MAX_ROUNDED_SHARE)
    relative = 2.0**-9 if found.dtype == np.float16 else 1e-5
    return bool(
        np.allclose(
            found.astype(float), expected.astype(float), rtol=relative, atol=1e-5
        )
    )


def assert_same_frame(found, expected, *, is_exact=False):
    """Fail unless `is_same_frame`; say how the images differ."""
    if is_same_frame(found, expected, is_exact=is_exact):
        return
    assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    steps = np.abs(found.astype(float) - expected.astype(float))
    raise AssertionError(
        f"{np.count_nonzero(steps)} of {steps.size} values differ, by up to "
        f"{steps.max():g}; the first at {np.argwhere(steps > 0)[:1].tolist()}"
    )
