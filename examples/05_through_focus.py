"""Through focus: three eyes look at a card at 50 cm and focus at five distances.

    python examples/05_through_focus.py

Each row shows an eye, and each column a requested focus distance.  Accommodation can
only add power, so a myopic eye cannot focus beyond its far point.
"""

import numpy as np
from common import font, save_pictures
from PIL import Image, ImageDraw

from ocufilter import Camera, EyeFilter, FilterSettings

SIDE_PX = 150
CARD_DPT = 2.0  # 50 cm
FOCI_DPT = (0.0, 1.0, 2.0, 3.0, 4.0)
EYES = {
    "no error": "emmetropia",
    "-3 diopters": {"kind": "prescription", "sphere_dpt": -3.0},
    "after LASIK": "post_lasik",
}

card = Image.new("RGB", (SIDE_PX, SIDE_PX), "white")
draw = ImageDraw.Draw(card)
for text, size_px, y in (
    ("E N T", 44, 14),
    ("O P T I C", 24, 70),
    ("S A H L Z", 15, 112),
):
    draw.text((SIDE_PX / 2, y), text, fill="black", font=font(size_px), anchor="ma")
color = np.array(card)
depth_m = np.full((SIDE_PX, SIDE_PX), 1.0 / CARD_DPT, np.float32)
camera = Camera.from_fov(2.5, width_px=SIDE_PX, height_px=SIDE_PX)
settings = FilterSettings(  # limits the PSFs to the states that are used
    pupil_range_mm=(4.0, 4.0),
    focus_range_dpt=(FOCI_DPT[0], FOCI_DPT[-1]),
    object_range_dpt=(CARD_DPT, CARD_DPT),
)

pictures = []
with EyeFilter("emmetropia", camera, settings) as eye:
    for name, profile in EYES.items():
        eye.set_profile(profile)
        eye.wait()
        for focus_dpt in FOCI_DPT:
            state = {"pupil_diameter_mm": 4.0, "focus_dpt": focus_dpt}
            seen = eye.filter(color, depth_m, **state, whole=True)
            caption = f"{name}, at {seen.focus_dpt:.1f} dpt"
            pictures.append((caption, seen.color))
save_pictures("05_through_focus.png", pictures, columns=len(FOCI_DPT))
