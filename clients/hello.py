"""Minimal client: one image, filtered by a running service.

ocufilter serve &
python -m clients.hello blurred.png
"""

import sys

import numpy as np
from PIL import Image

from clients import FilterClient
from filter_service import Camera

WIDTH_PX, HEIGHT_PX = 480, 270


def main(out: str = "hello.png", endpoint: str = "tcp://127.0.0.1:5577") -> None:
    """Filter a checkered wall, near on the left and far on the right, for a myope."""
    rows, columns = np.indices((HEIGHT_PX, WIDTH_PX))
    squares = 255 * ((rows // 15 + columns // 15) % 2)
    color = np.repeat(squares[..., None], 3, axis=2).astype(np.uint8)  # sRGB
    depth_m = np.geomspace(0.2, 5.0, WIDTH_PX, dtype=np.float32)
    depth_m = np.ascontiguousarray(np.broadcast_to(depth_m, squares.shape))

    camera = Camera.from_fov(50.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    with FilterClient(endpoint) as client:
        client.set_profile("myopia", views=[camera])
        seen = client.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0)
    Image.fromarray(seen.color).save(out)


if __name__ == "__main__":
    main(*sys.argv[1:])
