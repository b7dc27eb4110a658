"""Warm-up: plan a tiny frame, so that all dependencies are loaded in advance.

Importing numba and SciPy and loading the compiled loops takes 1 s; the service does so
after it is ready.  Compilation takes 10 s, once per machine.
"""

import numpy as np

from estimator.media.straylight import Straylight
from filter_service.camera import Camera
from filter_service.constants import RGB
from filter_service.psfs.frame_layers import frame_layers
from filter_service.rendering.frame import fill_missing_depth
from filter_service.rendering.frame_kernels import (
    frame_kernels,
    interval_count,
)
from filter_service.rendering.image_cells import image_cells
from filter_service.rendering.media_effects import MediaEffects
from filter_service.rendering.perfect_eye import (
    PUPIL_MM,
    SIDE_PX,
    TANGENTS,
    perfect_store,
)
from filter_service.rgbd_view import RgbdView


def plan_once() -> None:
    """Run every compiled loop of frame planning once, without rendering."""
    from scipy import interpolate  # noqa: F401  (used by `FieldDefocus`)

    store = perfect_store(Camera(SIDE_PX, SIDE_PX, TANGENTS))
    layers = frame_layers(store, pupil_diameter_mm=PUPIL_MM, focus_dpt=0.0)
    image = image_cells(store.spec, store.plan)
    used = np.ones((image.count, interval_count(layers)), bool)
    frame_kernels(store, layers, image, used)
    depth_m = np.ones((2, 2), np.float32)
    depth_m[0, 0] = np.nan
    fill_missing_depth(depth_m)
    light = np.ones((SIDE_PX, SIDE_PX, RGB), np.float32)
    view = RgbdView(light, light[..., 0].copy(), store.spec.camera.tangents)
    MediaEffects(Straylight()).apply(light, view)
