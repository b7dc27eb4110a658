"""First image: a courtyard as a person with -6 diopters sees it without glasses.

    python examples/01_first_picture.py

The example loads a scene, creates an eye and filters one frame.  Distances are in
meters, pupils in millimeters and focus in diopters (1 / meters; 0 is infinity).
"""

from common import load_courtyard, save_pictures

from ocufilter import EyeFilter

color, depth_m, camera = load_courtyard()
with EyeFilter("myopia", camera) as eye:
    seen = eye.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0, whole=True)

save_pictures(
    "01_first_picture.png",
    [("the scene", color), ("-6 diopters, pupil 4 mm, looking far away", seen.color)],
)
