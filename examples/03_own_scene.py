"""Your own scene: filter any image for which you know the distance of each pixel.

    python examples/03_own_scene.py

The scene consists of three cards in front of a wall, at 25 cm, 1 m and 5 m.  Color is
an 8-bit sRGB array, and distance is a 32-bit float array in meters, as produced by a
renderer or a depth camera.  A 40-year-old, who cannot quite focus at 25 cm, looks at
one card after the other.
"""

import numpy as np
from common import font, save_pictures
from PIL import Image, ImageDraw

from ocufilter import Camera, EyeFilter

WIDTH_PX, HEIGHT_PX = 480, 200
CARDS = {  # text: (distance m, left edge px)
    "25 cm": (0.25, 20),
    "1 m": (1.0, 175),
    "5 m": (5.0, 330),
}
CARD_PX = 130
WALL_M = 8.0

scene = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "#8fa3ad")
draw = ImageDraw.Draw(scene)
for x in range(0, WIDTH_PX, 24):  # stripes on the wall
    draw.rectangle((x, 0, x + 11, HEIGHT_PX), fill="#7d929d")
depth_m = np.full((HEIGHT_PX, WIDTH_PX), WALL_M, np.float32)
for text, (distance_m, left) in CARDS.items():
    box = (left, 35, left + CARD_PX, 165)
    draw.rectangle(box, fill="#fbf7ea", outline="#1b2126", width=3)
    for row, size_px in enumerate((34, 22, 15, 10)):
        draw.text((left + 12, 44 + 32 * row), text, fill="#1b2126", font=font(size_px))
    depth_m[box[1] : box[3] + 1, box[0] : box[2] + 1] = distance_m
color = np.array(scene)

# The image covers a vertical angle of 12 degrees.
camera = Camera.from_fov(12.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
person = {"kind": "preset", "name": "emmetropia", "age_years": 40}

pictures = [("the scene", color)]
with EyeFilter(person, camera) as eye:
    for text, (distance_m, _) in CARDS.items():
        state = {"pupil_diameter_mm": 5.0, "focus_dpt": 1.0 / distance_m}
        seen = eye.filter(color, depth_m, **state, whole=True)
        caption = f"looking at {text}: focused at {1 / seen.focus_dpt:.2g} m"
        pictures.append((caption, seen.color))
save_pictures("03_own_scene.png", pictures)
