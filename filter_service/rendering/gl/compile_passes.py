"""Compiles every pass before the first client comes, by filtering a few pixels.

A software renderer translates a shader at its first dispatch; without this, the first
frames through a new service stall by half a second.  The loops that plan a frame are
compiled too, in 8 s on two busy cores, but only once: they are kept on disk.
"""

import numpy as np

from filter_service.camera import Camera
from filter_service.constants import RGB
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.perfect_store import PUPIL_MM, perfect_store
from filter_service.rgbd_view import RgbdView

SIDE_PX = 16
TANGENTS = (-0.01, 0.01, 0.01, -0.01)


def compile_passes(renderer: FilterRenderer) -> float:
    """Render a tiny frame in every variant that clients may ask for.

    Returns
    -------
    float
        The largest change of a pixel's value, which a perfect eye leaves as it is.
    """
    changes = []
    handle = renderer.load(perfect_store(Camera(SIDE_PX, SIDE_PX, TANGENTS)))
    depth_m = np.ones((SIDE_PX, SIDE_PX), np.float32)
    for dtype, output, accumulations in (
        (np.uint8, "srgb8", ("coverage", "paper")),
        (np.float32, "linear", ("coverage",)),
        (np.float16, "linear16", ("coverage",)),
    ):
        view = RgbdView(np.ones((SIDE_PX, SIDE_PX, RGB), dtype), depth_m, TANGENTS)
        for accumulation in accumulations:
            rendered = renderer.render(
                view,
                handle,
                pupil_diameter_mm=PUPIL_MM,
                focus_dpt=0.0,
                accumulation=accumulation,
                output=output,
            )
            changes.append(np.abs(rendered.color.astype(np.float32) - view.color))
    handle.release()
    return float(np.max(changes))
