"""Stereo: a person whose left eye is myopic and whose right eye is emmetropic.

    python examples/04_stereo.py

Each eye has its own filter, and `plan_views` filters a frame through both.  The two
views are rendered from positions 63 mm apart.  This example shifts the cards; in a
headset, the renderer provides the views.  Fuse the pair by crossing your eyes: the
sharper view usually dominates.
"""

import numpy as np
from common import font, save_pictures
from PIL import Image, ImageDraw

from ocufilter import Camera, EyeFilter, RgbdView, ViewState, plan_views

WIDTH_PX, HEIGHT_PX = 360, 270
EYES_APART_M = 0.063
WALL_M = 6.0
CARDS = (  # text, distance m, center x and y m, side m
    ("far", 4.0, -0.40, 0.20, 0.70),
    ("mid", 1.5, 0.20, -0.10, 0.30),
    ("near", 0.5, -0.03, -0.07, 0.10),
)
PROFILES = {
    "left": {"kind": "prescription", "sphere_dpt": -2.5, "eye_side": "OS"},
    "right": {"kind": "preset", "name": "emmetropia"},
}

camera = Camera.from_fov(30.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)
px_per_tangent = HEIGHT_PX / (camera.tangents[2] - camera.tangents[3])


def rendered(eye_x_m):
    """Return color and depth of the cards for an eye at `eye_x_m` (right: positive)."""
    picture = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "#9db0a5")
    draw = ImageDraw.Draw(picture)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), WALL_M, np.float32)
    for text, distance_m, x_m, y_m, side_m in CARDS:
        scale = px_per_tangent / distance_m
        x = WIDTH_PX / 2 + (x_m - eye_x_m) * scale
        y = HEIGHT_PX / 2 - y_m * scale
        half = side_m * scale / 2
        left, top, right, bottom = (
            round(v) for v in (x - half, y - half, x + half, y + half)
        )
        draw.rectangle((left, top, right, bottom), fill="#fbf7ea", outline="#1b2126")
        draw.text((x, y), text, fill="#9a3a00", font=font(int(half * 0.8)), anchor="mm")
        inside = (slice(max(0, top), bottom + 1), slice(max(0, left), right + 1))
        depth_m[inside] = distance_m
    return np.array(picture), depth_m


sides = {"left": -EYES_APART_M / 2, "right": EYES_APART_M / 2}
views = [RgbdView(*rendered(x_m), camera.tangents) for x_m in sides.values()]
states = [ViewState(side) for side in sides]

filters = {side: EyeFilter(PROFILES[side], camera) for side in sides}
for eye_filter in filters.values():
    eye_filter.wait()
planned = plan_views(filters.get, views, states, pupil_diameter_mm=4.5, focus_dpt=0.5)
assert planned  # both eyes are ready
seen = planned.render().views
for eye_filter in filters.values():
    eye_filter.close()

save_pictures(
    "04_stereo.png",
    [
        ("left view", views[0].color),
        ("right view", views[1].color),
        ("left eye, -2.5 diopters, focused at 2 m", seen[0].color),
        ("right eye, no error, focused at 2 m", seen[1].color),
    ],
)
