"""The eye of a profile: estimated, given by its surfaces, or after surgery."""

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.estimate.given_surfaces import GivenSurfaces
from estimator.estimate.surgery import operated_eye
from estimator.profiles.parse import EyeProfile

EyeModel = EstimatedEye | GivenSurfaces
"""An eye that can be traced, whatever its profile."""


def eye_model(profile: EyeProfile) -> EyeModel:
    """Return the eye of a profile: as given by surfaces, or estimated from the table.

    With surgery, this is the estimated eye after it.

    Raises
    ------
    TraceFailed
        Light does not pass the eye, or no surgery gives the residual refraction.
    """
    if profile.surfaces is not None:
        return GivenSurfaces(profile, profile.surfaces)
    if profile.surgery is not None:
        return operated_eye(profile)
    return estimate_eye(profile, starts=("table",))
