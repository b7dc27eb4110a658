"""A card, solved for a viewer of -1 diopter, who looks at a far display.

    python examples/11_correct.py

The upper row shows the display, and the lower row what the viewer sees: of the card, of
the picture solved for it, and of one solved for a gray card of half the contrast.  A
display cannot go below black nor above white, so that less contrast leaves more room
for the correction.
"""

import numpy as np
from common import font, save_pictures
from PIL import Image, ImageDraw

from ocufilter import Camera, RgbdView, correct

WIDTH_PX, HEIGHT_PX = 240, 150
VIEWER = {"kind": "prescription", "sphere_dpt": -1.0}
STATE = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.0}


def srgb8(linear):
    """Return linear light as 8-bit sRGB."""
    value = np.clip(linear, 0.0, 1.0)
    curve = 1.055 * value ** (1.0 / 2.4) - 0.055
    return np.rint(255.0 * np.where(value < 0.0031, 12.92 * value, curve)).astype("u1")


card = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "white")
draw = ImageDraw.Draw(card)
for text, size_px, y in (
    ("E N T", 50, 10),
    ("O P T I C", 30, 72),
    ("S A H L Z", 20, 116),
):
    draw.text((WIDTH_PX / 2, y), text, fill="black", font=font(size_px), anchor="ma")
far_m = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32)
camera = Camera.from_fov(4.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
view = RgbdView(np.array(card), far_m, camera.tangents)

full = correct(view, VIEWER, **STATE)
half = correct(view, VIEWER, **STATE, contrast=0.5, brightness=0.6)
for found in (full, half):
    print(
        f"contrast {found.contrast_ratio:g}: {found.psnr_before_db:.1f} dB before, "
        f"{found.psnr_after_db:.1f} dB after {found.iteration_count} iterations"
    )
pictures = [
    ("the card", view.color),
    ("solved", full.color_srgb8),
    ("solved for half the contrast", half.color_srgb8),
    ("seen by the viewer", srgb8(full.before)),
    (f"seen: {full.psnr_after_db:.1f} dB", srgb8(full.after)),
    (f"seen: {half.psnr_after_db:.1f} dB", srgb8(half.after)),
]
save_pictures("11_correct.png", pictures, columns=3)
