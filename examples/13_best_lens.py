"""The lens that is best for what an eye looks at, beside its best correction.

    python examples/13_best_lens.py

The upper row shows a card on a far wall and an eye with keratoconus and a pupil of 5
mm: without a lens, and with the spectacles that `best_lens` finds for the card.  The
lower row shows an eye of 60 years, which does not accommodate, and cards far away and
at 0.8 m: with the lens that is best for the far card, and with the one that is best
for both.
"""

import numpy as np
from common import font, save_pictures
from PIL import Image, ImageDraw

from ocufilter import Camera, LensScene, RgbdView, best_lens

WIDTH_PX, HEIGHT_PX = 240, 150
CONE = {"kind": "preset", "name": "keratoconus"}
OLD = {"kind": "prescription", "sphere_dpt": 0.0, "age_years": 60}
SETTINGS = {"mode": "on-axis"}
camera = Camera.from_fov(4.0, width_px=WIDTH_PX, height_px=HEIGHT_PX)


def srgb8(light):
    """Return linear light as 8-bit sRGB."""
    value = np.clip(light, 0.0, 1.0)
    curve = 1.055 * value ** (1.0 / 2.4) - 0.055
    return np.rint(255.0 * np.where(value < 0.0031, 12.92 * value, curve)).astype("u1")


def card(distance_m, lines):
    """Return a card of letters at a distance."""
    image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "white")
    draw = ImageDraw.Draw(image)
    for text, size_px, y in lines:
        place = (WIDTH_PX / 2, y)
        draw.text(place, text, fill="black", font=font(size_px), anchor="ma")
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), distance_m, np.float32)
    return RgbdView(np.array(image), depth_m, camera.tangents)


def lens_text(trial):
    """Return a prescription as people write it."""
    lens = trial.prescription
    text = f"{lens.sphere_dpt:+.2f}"
    if lens.cylinder_dpt:
        text += f" / {lens.cylinder_dpt:+.2f} x {lens.axis_deg:.0f}"
    return text


far = card(np.inf, (("E N T", 50, 10), ("O P T I C", 30, 72), ("S A H L Z", 20, 116)))
near = card(0.8, (("R E A D", 44, 10), ("A B O O K", 30, 72), ("A T H O M E", 20, 116)))

cone = best_lens(CONE, LensScene(view=far, pupil_diameter_mm=5.0), settings=SETTINGS)
scenes = [LensScene(view=view, pupil_diameter_mm=4.0) for view in (far, near)]
for_far, for_both = (
    best_lens(OLD, some, has_cylinder=False, settings=SETTINGS)
    for some in (scenes[:1], scenes)
)
for name, found in (
    ("keratoconus, far", cone),
    ("60 years, far", for_far),
    ("60 years, far and near", for_both),
):
    print(
        f"{name}: {lens_text(found.best)}, rounded {lens_text(found.rounded)} "
        f"({found.rounding_loss_db:.2f} dB); highest visual Strehl ratio "
        f"{lens_text(found.start)} ({found.gain_over_start_db:.2f} dB)"
    )
save_pictures(
    "13_best_lens.png",
    [
        ("the card", far.color),
        ("keratoconus, no lens", srgb8(cone.before)),
        (lens_text(cone.best), srgb8(cone.after)),
        ("60 years, no lens", srgb8(for_far.before)),
        (f"best for far: {lens_text(for_far.best)}", srgb8(for_far.after)),
        (f"best for both: {lens_text(for_both.best)}", srgb8(for_both.after)),
    ],
    columns=3,
)
