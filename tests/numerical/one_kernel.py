"""Stores in which every PSF is one given kernel: filtering has a closed form then."""

from dataclasses import replace

import numpy as np
from scipy.signal import fftconvolve

from filter_service.camera import Camera
from filter_service.constants import RGB, WEIGHT_MAX
from filter_service.psfs.pack import PackedKernels
from filter_service.psfs.store import PsfStore
from filter_service.rendering.perfect_eye import PUPIL_MM, perfect_store
from filter_service.rgbd_view import RgbdView

PITCH_RAD = 1e-3


def disc(radius_px):
    """Kernel (2 r + 1, 2 r + 1) of unit sum: even light within a circle."""
    y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    lit = x * x + y * y <= (radius_px + 0.5) ** 2
    return lit / lit.sum()


class OneKernelBench:
    """A camera of 1 mrad a pixel before an eye with one square kernel."""

    def __init__(self, engine, kernel, *, width_px, height_px, spread_px=0.0):
        right, up = PITCH_RAD * width_px / 2, PITCH_RAD * height_px / 2
        self.tangents = (-right, right, up, -up)
        self.size = (height_px, width_px)
        self.kernel = kernel
        self.store = _store(
            kernel, Camera(width_px, height_px, self.tangents), spread_px
        )
        self.gpu = engine.gpu
        self.renderer = engine.new_renderer()
        self.handle = self.renderer.load(self.store)

    def render(self, color, depth_m=1.0, **options):
        depth_m = np.broadcast_to(np.float32(depth_m), self.size)
        view = RgbdView(color, depth_m.astype(np.float32), self.tangents, "radial")
        return self.renderer.render(
            view, self.handle, pupil_diameter_mm=PUPIL_MM, focus_dpt=0.0, **options
        )

    def plane_truth(self, color):
        """One surface at one distance: the convolution over what arrives, float64."""
        kernel = self.kernel[:, :, None]
        ones = np.ones((*self.size, 1))
        light = fftconvolve(color.astype(float), kernel, mode="same", axes=(0, 1))
        return light / fftconvolve(ones, kernel, mode="same", axes=(0, 1))


def _store(kernel, camera, spread_px):
    radius_px = kernel.shape[0] // 2
    one = np.ones(RGB)
    perfect = perfect_store(camera)
    packed = PackedKernels(
        weights=np.round(kernel / kernel.max() * WEIGHT_MAX).astype(np.uint16).ravel(),
        offsets=np.zeros(RGB, np.int64),
        reach_px=np.full((RGB, 4), radius_px),
        radius_px=np.full(RGB, radius_px),
        spread_px=spread_px * one,
        peak_ratio=kernel.max() * one,
        lost_energy_ratio=0.0 * one,
    )
    blur_px = np.full(RGB, radius_px, np.float32)
    nodes = replace(perfect.nodes, blur_px=blur_px)
    plan = replace(perfect.plan, nodes=nodes)
    return PsfStore.of_kernels(perfect.eye, perfect.spec, plan, packed)
