"""Eyes in the format of profiles of kind ``surfaces``."""

from estimator.optics.surfaces import EyeSurfaces
from estimator.profiles.parse import parse_profile


def parsed_eye(body: dict) -> EyeSurfaces:
    """Return the relaxed eye of the body of a profile, whose kind may be missing."""
    return parse_profile({"kind": "surfaces", **body}).surfaces.relaxed
