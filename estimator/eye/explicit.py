"""An eye given surface by surface in JSON, such as a schematic eye.

    {"surfaces": [{"radius_mm": 7.72 | [Rx, Ry] | null (plane), "conic_constant": -0.26,
                   "z_mm": 0, "medium_after": "cornea",
                   optional: "offset_mm": [27 or 28 terms], "offset_radius_mm",
                   "rotation_deg", "decentration_mm": [x, y], "tilt_deg": [x, y],
                   "clear_radius_mm", "form": {"kind": "even_asphere", ...}}, ...],
     "stop_z_mm": 3.6,
     "retina": {"radius_mm": 12, "conic_constant": 0, "z_mm": 24,
                optional: "rotation_deg", "decentration_mm", "tilt_deg", "form"},
     "indices": {"cornea": 1.376, ...} or null,
     "media": {"lens": {"kind": "cauchy", "coefficients": [1.4, 0.006]}, ...} or null}

27 offset terms are j = 1 to 27, 28 are j = 0 to 27.  The kinds of a form are those of
`estimator.optics.forms`, those of a medium are those of `estimator.optics.dispersion`
and `estimator.optics.gradients`; their fields are the attributes of the classes.  Media
in neither ``indices`` nor ``media`` follow Herzberger's formula (`media`).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from estimator.eye import checked_fields as fields
from estimator.eye.checked_fields import ProfileError
from estimator.eye.tagged import tagged
from estimator.optics.dispersion import DISPERSIONS, Dispersion
from estimator.optics.forms import FORMS, Form
from estimator.optics.gradients import GRADIENTS, Gradient
from estimator.optics.media import MEDIA
from estimator.optics.raytrace import check_order
from estimator.optics.surfaces import (
    MAX_SURFACES,
    OFFSET_RADIUS_MM,
    EyeSurfaces,
    Retina,
    Surface,
    check_eye,
    media_indices,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS

EYE_FIELDS = (
    *("surfaces", "stop_z_mm", "retina", "indices", "media"),
    *("name", "eye_side"),
)
SURFACE_FIELDS = (
    "name",
    "radius_mm",
    "conic_constant",
    "z_mm",
    "medium_after",
    "offset_mm",
    "offset_radius_mm",
    "rotation_deg",
    "decentration_mm",
    "tilt_deg",
    "clear_radius_mm",
    "form",
)
RETINA_FIELDS = (
    *("radius_mm", "conic_constant", "z_mm", "rotation_deg"),
    *("decentration_mm", "tilt_deg", "form", "name"),
)

RADIUS_LIMITS_MM = (0.5, 1e9)
CONIC_LIMITS = (-1000.0, 1000.0)
DEPTH_LIMITS_MM = (-50.0, 100.0)
INDEX_LIMITS = (1.0, 3.0)
OFFSET_LIMIT_MM = 2.0


def is_explicit_eye(data: object) -> bool:
    """Return whether a profile describes an eye by its surfaces."""
    return isinstance(data, Mapping) and "surfaces" in data


def parse_explicit_eye(data: object) -> EyeSurfaces:
    """Parse an eye in the format of this module.

    Raises
    ------
    ProfileError
        A field is invalid; the error names it and the allowed range.
    """
    data = fields.mapping(data, "eye")
    fields.only_known(data, EYE_FIELDS)
    entries = data.get("surfaces")
    if not _is_list(entries) or not 1 <= len(entries) <= MAX_SURFACES:
        allowed = f"a list of 1 to {MAX_SURFACES} surfaces"
        raise ProfileError("surfaces", "is no such list", allowed)
    indices = _indices(data.get("indices"))
    media = _media(data.get("media"))
    known = (*MEDIA, *(indices or {}), *(media or {}))
    eye = EyeSurfaces(
        surfaces=tuple(
            _surface(entry, f"surfaces[{i}]", known) for i, entry in enumerate(entries)
        ),
        stop_z_mm=fields.number(data, "stop_z_mm", *DEPTH_LIMITS_MM),
        retina=_retina(data.get("retina")),
        indices=indices,
        media=media,
    )
    try:
        check_eye(eye)
        check_order(eye)
        if media:
            media_indices(eye, REFERENCE_WAVELENGTH_NM)
    except ValueError as error:
        raise ProfileError("surfaces", str(error), "surfaces in order") from None
    return eye


def _is_list(value: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def _indices(data: object) -> dict[str, float] | None:
    if data is None:
        return None
    data = fields.mapping(data, "indices")
    return {
        medium: fields.number(data, medium, *INDEX_LIMITS, path="indices.")
        for medium in data
    }


def _media(data: object) -> dict[str, Dispersion | Gradient] | None:
    if data is None:
        return None
    data = fields.mapping(data, "media")
    table = (*DISPERSIONS, *GRADIENTS)
    return {name: tagged(data[name], table, f"media.{name}") for name in data}


def _form(data: Mapping[str, Any], path: str) -> Form | None:
    if data.get("form") is None:
        return None
    form: Form = tagged(data["form"], FORMS, f"{path}form")
    return form


def _surface(data: object, name: str, media: Sequence[str]) -> Surface:
    data = fields.mapping(data, name)
    path = f"{name}."
    fields.only_known(data, SURFACE_FIELDS, path=path)

    def number(field: str, low: float, high: float, default: float) -> float:
        return fields.number(data, field, low, high, default=default, path=path)

    clear_mm = data.get("clear_radius_mm")
    return Surface(
        radius_mm=_radii(data, path),
        conic_constant=number("conic_constant", *CONIC_LIMITS, default=0.0),
        z_mm=fields.number(data, "z_mm", *DEPTH_LIMITS_MM, path=path),
        medium_after=fields.choice(data, "medium_after", media, path=path),
        rotation_deg=number("rotation_deg", -360.0, 360.0, default=0.0),
        decentration_mm=_pair(data, "decentration_mm", 5.0, path),
        tilt_deg=_pair(data, "tilt_deg", 45.0, path),
        offset_mm=_offsets(data, path),
        offset_radius_mm=number("offset_radius_mm", 0.5, 50.0, OFFSET_RADIUS_MM),
        clear_radius_mm=(
            math.inf if clear_mm is None else number("clear_radius_mm", 0.1, 50.0, 0.0)
        ),
        form=_form(data, path),
    )


def _radius(value: object, name: str) -> float:
    """Return a radius of curvature; null, "inf" and Infinity are planes."""
    low, high = RADIUS_LIMITS_MM
    if value is None or value in ("inf", "Infinity", math.inf, -math.inf):
        return math.inf
    allowed = f"a radius of {low:g} mm or more, of either sign, or null for a plane"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ProfileError(name, f"{value!r} is not a number", allowed)
    if not low <= abs(value) <= high:
        raise ProfileError(name, f"{value!r} is out of range", allowed)
    return float(value)


def _radii(data: Mapping[str, Any], path: str) -> tuple[float, float]:
    name = f"{path}radius_mm"
    if "radius_mm" not in data:
        raise ProfileError(name, "is missing", "a number, [Rx, Ry] or null (plane)")
    value = data["radius_mm"]
    if not _is_list(value):
        return (_radius(value, name),) * 2
    if len(value) != 2:
        raise ProfileError(name, f"{len(value)} numbers", "a number or [Rx, Ry]")
    return _radius(value[0], f"{name}[0]"), _radius(value[1], f"{name}[1]")


def _pair(
    data: Mapping[str, Any], field: str, limit: float, path: str
) -> tuple[float, float]:
    value = data.get(field)
    if value is None:
        return 0.0, 0.0
    if not _is_list(value) or len(value) != 2:
        raise ProfileError(path + field, f"{value!r:.40}", "two numbers [x, y]")
    named = {f"{field}[{i}]": v for i, v in enumerate(value)}
    x, y = (fields.number(named, k, -limit, limit, path=path) for k in named)
    return x, y


def _offsets(data: Mapping[str, Any], path: str) -> NDArray[np.float64] | None:
    value = data.get("offset_mm")
    if value is None:
        return None
    if not _is_list(value) or len(value) not in (N_TERMS - 1, N_TERMS):
        allowed = f"{N_TERMS - 1} numbers (j = 1 on) or {N_TERMS} (j = 0 on)"
        raise ProfileError(f"{path}offset_mm", "is no such list", allowed)
    first = N_TERMS - len(value)
    named = {f"offset_mm[{i}]": v for i, v in enumerate(value)}
    limit = OFFSET_LIMIT_MM
    terms = [fields.number(named, k, -limit, limit, path=path) for k in named]
    return np.array([0.0] * first + terms)


def _retina(data: object) -> Retina:
    data = fields.mapping(data, "retina")
    path = "retina."
    fields.only_known(data, RETINA_FIELDS, path=path)
    return Retina(
        radius_mm=_radii(data, path),
        conic_constant=fields.number(
            data, "conic_constant", *CONIC_LIMITS, default=0.0, path=path
        ),
        z_mm=fields.number(data, "z_mm", *DEPTH_LIMITS_MM, path=path),
        rotation_deg=fields.number(
            data, "rotation_deg", -360.0, 360.0, default=0.0, path=path
        ),
        decentration_mm=_pair(data, "decentration_mm", 5.0, path),
        tilt_deg=_pair(data, "tilt_deg", 45.0, path),
        form=_form(data, path),
    )
