"""Options of any profile: periphery, straylight, yellowing, spectacle magnification.

Each function parses its field of a profile object and raises `ProfileError` with the
field, the invalid value and the accepted values.
"""

from collections.abc import Mapping
from typing import Any

from estimator.eye import checked_fields as fields
from estimator.eye.checked_fields import ProfileError
from estimator.media.absorption import YELLOWINGS
from estimator.media.straylight import (
    BROWN,
    CATARACTS,
    DEFAULT_AGE_YEARS,
    Straylight,
)

FIELDS = ("periphery", "straylight", "yellowing", "spectacle_magnification")
STRAYLIGHT_FIELDS = ("pigmentation", "log_s", "cataract")
PERIPHERIES = ("people", "model")
"""Source of a traced eye's wavefronts off the axis: measured people with such an axis,
or the surfaces of the eye model alone."""


def periphery(data: Mapping[str, Any], *, has_own: bool) -> str:
    """Return one of `PERIPHERIES`; ``has_own`` if the profile gives a retina."""
    is_model = has_own or data.get("kind") == "eye"
    found = fields.choice(
        data, "periphery", PERIPHERIES, default="model" if is_model else "people"
    )
    if is_model and found != "model":
        raise ProfileError(
            "periphery",
            "is 'people', but the profile gives the eye's own surfaces",
            "model, for kind 'eye' and beside 'retina'",
        )
    return found


def straylight(data: Mapping[str, Any], age_years: float | None) -> Straylight | None:
    """Return the requested straylight, or None."""
    if data.get("straylight") is None:
        return None
    path = "straylight."
    body = fields.mapping(data["straylight"], "straylight")
    fields.only_known(body, STRAYLIGHT_FIELDS, path=path)
    log_s = None
    if "cataract" in body:
        log_s = CATARACTS[fields.choice(body, "cataract", tuple(CATARACTS), path=path)]
    if "log_s" in body:
        if log_s is not None:
            raise ProfileError(
                path + "log_s", "stands beside a cataract", "one of the two"
            )
        log_s = fields.number(body, "log_s", 0.5, 2.5, path=path)
    return Straylight(
        age_years=DEFAULT_AGE_YEARS if age_years is None else age_years,
        pigment_ratio=fields.number(
            body, "pigmentation", 0.0, 1.2, default=BROWN, path=path
        ),
        log_s=log_s,
    )


def spectacle_magnification(data: Mapping[str, Any]) -> bool:
    """Return whether the correction's magnification is applied."""
    wanted = data.get("spectacle_magnification", False)
    if not isinstance(wanted, bool):
        raise ProfileError(
            "spectacle_magnification", f"{wanted!r:.40} is neither", "true or false"
        )
    if wanted and data.get("correction") is None:
        raise ProfileError("correction", "is missing beside the magnification", "one")
    return wanted


def yellowing(data: Mapping[str, Any]) -> str | None:
    """Return the mode of the aging lens's yellowing, or None if not requested."""
    if data.get("yellowing") is None:
        return None
    if "age_years" not in data:
        raise ProfileError("age_years", "is missing beside yellowing", "3 to 120")
    return fields.choice(data, "yellowing", YELLOWINGS)
