"""A small picture for the tests of the page."""

import numpy as np

from clients.web.picture import Picture, picture_of
from filter_service import Camera, RgbdView


def a_picture(width_px: int = 60, height_px: int = 40) -> Picture:
    """Return squares 2 m away, 8 deg high."""
    rows, columns = np.indices((height_px, width_px))
    squares = (255 * ((rows // 5 + columns // 5) % 2)).astype(np.uint8)
    camera = Camera.from_fov(8.0, width_px=width_px, height_px=height_px)
    view = RgbdView(
        np.repeat(squares[..., None], 3, axis=2),
        np.full((height_px, width_px), 2.0, np.float32),
        camera.tangents,
    )
    return picture_of("squares", view)
