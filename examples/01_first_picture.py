"""First picture: what a person with -6 diopters sees of a courtyard without glasses.

    python examples/01_first_picture.py

Five lines do it: a scene, an eye, a frame.  Distances are in meters, pupils in
millimeters, focus in diopters (1 / meters; 0 is far away).
"""

from common import load_courtyard, save_pictures

from filter_service import EyeFilter

color, depth_m, camera = load_courtyard()
with EyeFilter("myopia", camera) as eye:
    seen = eye.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0, whole=True)

save_pictures(
    "01_first_picture.png",
    [("the scene", color), ("-6 diopters, pupil 4 mm, looking far away", seen.color)],
)
