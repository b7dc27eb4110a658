"""Scene and contact sheet that the examples share.

The scene is a courtyard of 480 x 270 pixels.  Its color is a JPEG file, and its depth a
16-bit PNG file in millimeters, in which 65535 is the sky.
"""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ocufilter import Camera

DATA = Path(__file__).parent / "data"
OUT = Path("out/examples")
FIELD_OF_VIEW_DEG = 50.0  # vertical
SKY_MM = 65535

CAPTION_PX = 26
GAP_PX = 6


def load_courtyard():
    """Return color (8-bit sRGB), depth in meters, and the camera."""
    color = np.array(Image.open(DATA / "courtyard.jpg"))
    millimeters = np.array(Image.open(DATA / "courtyard_depth.png"))
    depth_m = np.where(millimeters == SKY_MM, np.inf, millimeters / 1000.0)
    height_px, width_px = depth_m.shape
    camera = Camera.from_fov(FIELD_OF_VIEW_DEG, width_px=width_px, height_px=height_px)
    return color, depth_m.astype(np.float32), camera


def font(size_px):
    """Return Pillow's default font."""
    return ImageFont.load_default(size=size_px)


def save_pictures(name, pictures, *, columns=2):
    """Write (caption, image) pairs as one image file, and print its path."""
    height_px, width_px = pictures[0][1].shape[:2]
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    step_x, step_y = width_px + GAP_PX, height_px + CAPTION_PX
    page = Image.new("RGB", (columns * step_x - GAP_PX, rows * step_y), "white")
    draw = ImageDraw.Draw(page)
    for k, (caption, picture) in enumerate(pictures):
        x, y = k % columns * step_x, k // columns * step_y
        page.paste(Image.fromarray(picture), (x, y))
        place = (x + 2, y + height_px + CAPTION_PX // 2)
        draw.text(place, caption, fill="#1b2126", font=font(15), anchor="lm")
    OUT.mkdir(parents=True, exist_ok=True)
    page.save(OUT / name)
    print(OUT / name)
