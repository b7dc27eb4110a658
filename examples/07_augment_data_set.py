"""Data augmentation: filter a data set through many eyes.

    python examples/07_augment_data_set.py

Images of Sloan letters at 4 m are filtered through eyes with random refraction, age and
pupil.  The labels describe the eye of each image, so that a model can be trained on
them too.  The example writes PNG files and labels.csv to out/examples/letters/.
"""

import csv

import numpy as np
from common import OUT, save_pictures
from PIL import Image

from ocufilter import EyeFilter, FilterSettings, stimuli

DISPLAY = stimuli.Display(width_px=96, height_px=96, pixel_arcmin=1.0)
LETTER_ARCMIN = 50.0  # 20/200
DISTANCE_DPT = 0.25  # 4 m
LETTER_COUNT, PEOPLE_COUNT = 4, 6

rng = np.random.default_rng(7)
letters = {
    letter: stimuli.sloan_letters(letter, height_arcmin=LETTER_ARCMIN, display=DISPLAY)
    for letter in rng.choice(list("CDHKNORSVZ"), LETTER_COUNT, replace=False)
}


def person():
    """Return a random prescription profile."""
    return {
        "kind": "prescription",
        "sphere_dpt": round(float(rng.normal(-0.6, 0.7)), 2),
        "cylinder_dpt": round(-float(rng.gamma(1.2, 0.4)), 2),
        "axis_deg": round(float(rng.uniform(1.0, 180.0))),
        "age_years": round(float(rng.uniform(20.0, 70.0))),
    }


folder = OUT / "letters"
folder.mkdir(parents=True, exist_ok=True)
settings = FilterSettings(
    mode="on-axis",  # an image of this size has the same PSF everywhere
    object_planes_dpt=(DISTANCE_DPT,),  # and a single distance
)
rows, pictures = [], []
# without a worker process, an eye for few images takes less processor time
with EyeFilter("emmetropia", DISPLAY.camera, settings, worker=False) as eye:
    for number in range(PEOPLE_COUNT):
        profile = person()
        pupil_mm = round(float(rng.uniform(2.5, 5.0)), 1)
        eye.set_profile(profile)
        eye.wait()
        for letter, stimulus in letters.items():
            state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": DISTANCE_DPT}
            view = stimulus.view(1.0 / DISTANCE_DPT)
            seen = eye.filter(view, **state, whole=True)
            file = f"{letter}_{number:02d}.png"
            Image.fromarray(seen.color).save(folder / file)
            rows.append(
                {"file": file, "letter": letter, "pupil_mm": pupil_mm} | profile
            )
            refraction = f"{profile['sphere_dpt']:+.1f} {profile['cylinder_dpt']:+.1f}"
            pictures.append((refraction, seen.color))

with (folder / "labels.csv").open("w", newline="", encoding="utf-8") as file:
    writer = csv.DictWriter(file, rows[0].keys())
    writer.writeheader()
    writer.writerows(rows)
print(f"{len(rows)} images, seen by {PEOPLE_COUNT} people, in {folder}")
save_pictures("07_augment_data_set.png", pictures, columns=2 * LETTER_COUNT)
