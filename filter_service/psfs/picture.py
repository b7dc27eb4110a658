"""Image of a PSF for display: logarithmic, enlarged, with a scale bar."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

DECADES = 4.0
"""Powers of ten between white and black.  The glare in the observer's own eye hides
anything darker."""

MIN_EDGE_PX = 384
MARGIN_PX = 12
BAR_HEIGHT_PX = 6
BAR_STEPS_ARCMIN = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def half_light_radius_px(kernel: NDArray[np.float32]) -> float:
    """Return the radius about the center element that contains half of the light, px.

    Parameters
    ----------
    kernel : (2 R + 1, 2 R + 1), unit sum
    """
    return light_radius_px(kernel, 0.5)


def light_radius_px(kernel: NDArray[np.float32], share_ratio: float) -> float:
    """Return the radius about the center element that contains a share of the light.

    Parameters
    ----------
    kernel : (2 R + 1, 2 R + 1)
    share_ratio : float
        Share of the light of the kernel, above 0 and below 1.

    Returns
    -------
    float
        In pixels.
    """
    radius_px = kernel.shape[0] // 2
    y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    distance_px = np.hypot(x, y).ravel()
    order = np.argsort(distance_px, kind="stable")
    light = np.cumsum(kernel.ravel()[order].astype(np.float64))
    last = np.searchsorted(light, share_ratio * light[-1])
    return float(distance_px[order][last])


def draw_psf(kernel: NDArray[np.float32], *, pixel_arcmin: float) -> NDArray[np.uint8]:
    """Draw a kernel in gray, with the peak white and `DECADES` below it black.

    Returns
    -------
    (height, width, 3)
        Image with a square for each kernel pixel, and a scale bar in arcmin.
    """
    floor = kernel.max() * 10.0**-DECADES
    decades = np.log10(np.maximum(kernel, floor) / floor)
    gray = np.round(255.0 * decades / DECADES).astype(np.uint8)
    zoom = max(1, -(-MIN_EDGE_PX // kernel.shape[0]))
    gray = gray.repeat(zoom, axis=0).repeat(zoom, axis=1)
    picture = Image.fromarray(gray).convert("RGB")
    _draw_scale_bar(picture, arcmin_per_px=pixel_arcmin / zoom)
    return np.asarray(picture)


def _draw_scale_bar(picture: Image.Image, *, arcmin_per_px: float) -> None:
    longest_arcmin = 0.4 * picture.width * arcmin_per_px
    fitting = [step for step in BAR_STEPS_ARCMIN if step <= longest_arcmin]
    bar_arcmin = fitting[-1] if fitting else BAR_STEPS_ARCMIN[0]
    bar_px = round(bar_arcmin / arcmin_per_px)
    draw = ImageDraw.Draw(picture)
    bottom = picture.height - MARGIN_PX
    box = (MARGIN_PX, bottom - BAR_HEIGHT_PX, MARGIN_PX + bar_px, bottom)
    draw.rectangle(box, fill="white", outline="black")
    label = f"{bar_arcmin:g} arcmin"
    where = (MARGIN_PX, bottom - BAR_HEIGHT_PX - 16)
    draw.text(where, label, fill="white", stroke_width=1, stroke_fill="black")
