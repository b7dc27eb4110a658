"""Eyes in the format of profiles of kind ``surfaces``."""

from estimator.optics.surfaces import EyeSurfaces
from estimator.profiles.parse import parse_profile

RELAXED = {
    "kind": "surfaces",
    "surfaces": [
        {"radius_mm": 7.8, "z_mm": 0, "medium_after": "cornea"},
        {"radius_mm": 6.5, "z_mm": 0.55, "medium_after": "aqueous"},
        {"radius_mm": 10.2, "z_mm": 3.6, "medium_after": "lens"},
        {"radius_mm": -6, "z_mm": 7.6, "medium_after": "vitreous"},
    ],
    "stop_z_mm": 3.6,
    "retina": {"radius_mm": 12, "z_mm": 24.2},
}


def parsed_eye(body: dict) -> EyeSurfaces:
    """Return the relaxed eye of the body of a profile, whose kind may be missing."""
    return parse_profile({"kind": "surfaces", **body}).surfaces.relaxed
