"""Prescriptions in FHIR: the resource VisionPrescription of R4, R4B and R5, as JSON.

A resource may have lenses for both eyes.  The fields `OWN_FIELDS` of a profile may be
added to it: ``eye_side`` selects the eye, and ``vertex_mm`` tells the distance of
spectacles from the cornea, which FHIR does not.

Source: https://hl7.org/fhir/R5/visionprescription.html and its two examples.
"""

from collections.abc import Mapping
from typing import Any

from estimator.eye.checked_fields import ProfileError

RESOURCE = "VisionPrescription"

OWN_FIELDS = ("eye_side", "vertex_mm", "age_years")
"""Fields of a profile that a resource may have as well."""

EYES = {"right": "OD", "left": "OS"}
CONTACT = "contact"
"""Code of a contact lens among the products of the specification's example codes."""

BASES = ("up", "down", "in", "out")
STATUSES = ("active", "cancelled", "draft")
"""Those of a prescription that may be used; the last two get a note."""

MAX_LENSES, MAX_PRISMS = 20, 8
MAX_SHOWN = 40
LENSES = "lensSpecification"


def is_vision_prescription(data: Mapping[str, Any]) -> bool:
    """Return whether a JSON object is a resource of FHIR."""
    return "resourceType" in data


def vision_prescription_body(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the body of one eye's prescription.

    Parameters
    ----------
    data : mapping
        A VisionPrescription.  Without ``eye_side``, the eye is the one that has a lens,
        or the right one.
    name : str
        Name of the profile.

    Raises
    ------
    ProfileError
        The object is another resource, an eye has no lens or several that differ, or a
        field is missing or of another type.  Ranges follow in `parse_profile`.
    """
    if data["resourceType"] != RESOURCE:
        raise ProfileError("resourceType", _shown(data["resourceType"]), RESOURCE)
    notes = _status_notes(data.get("status"))
    lenses = _lenses(data)
    side, is_chosen = _side(data, lenses)
    (found, where), *others = [
        (lens, where) for eye, lens, where in lenses if eye == side
    ]
    powers = _powers(found, where)
    for lens, elsewhere in others:
        if _powers(lens, elsewhere) != powers:
            raise ProfileError(
                elsewhere,
                f"differs from {where}, a lens of the same eye",
                "one lens for each eye: delete the others",
            )
    if not is_chosen:
        notes.append(
            f"the file has lenses for both eyes: the {_eye_name(side)} is used; "
            '"eye_side": "OS" in it selects the left one'
        )
    notes += _prism_notes(found, where)
    cylinders = {
        value > 0.0
        for _, lens, at in lenses
        if (value := _number(lens, "cylinder", at)) is not None and value != 0.0
    }
    if len(cylinders) == 2:
        notes.append("one eye has a plus cylinder, the other one a minus cylinder")
    body = {"kind": "prescription", "name": name, **powers}
    body.update({field: data[field] for field in OWN_FIELDS if field in data})
    body["eye_side"] = side
    if _is_contact(found, where):
        if body.get("vertex_mm"):
            raise ProfileError(
                "vertex_mm", "is given for a contact lens", "spectacles, or no field"
            )
        body["vertex_mm"] = 0.0
    if notes:
        body["notes"] = [{"code": "file_prescription", "text": text} for text in notes]
    return body


def _status_notes(status: object) -> list[str]:
    if status is None:
        return []
    if status not in STATUSES:
        raise ProfileError("status", _shown(status), " or ".join(STATUSES))
    return [] if status == STATUSES[0] else [f"the status of the file is {status}"]


def _lenses(data: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], str]]:
    """Return side, lens and path of each lens."""
    listed = data.get(LENSES)
    allowed = f"a list of 1 to {MAX_LENSES} lenses, as in R4 and R5"
    if listed is None and "dispense" in data:
        raise ProfileError("dispense", "is of FHIR before R4", f"{LENSES}: {allowed}")
    if not isinstance(listed, list) or not 1 <= len(listed) <= MAX_LENSES:
        raise ProfileError(LENSES, _shown(listed), allowed)
    found = []
    for number, lens in enumerate(listed):
        where = f"{LENSES}.{number}"
        if not isinstance(lens, Mapping):
            raise ProfileError(where, _shown(lens), "an object")
        eye = lens.get("eye")
        if not isinstance(eye, str) or eye not in EYES:
            raise ProfileError(f"{where}.eye", _shown(eye), " or ".join(EYES))
        found.append((EYES[eye], lens, where))
    return found


def _side(
    data: Mapping[str, Any], lenses: list[tuple[str, Mapping[str, Any], str]]
) -> tuple[str, bool]:
    """Return the side of the eye, and whether there was no choice or it was made."""
    sides = sorted({side for side, _, _ in lenses})
    if "eye_side" not in data:
        return sides[0], len(sides) == 1
    side = data["eye_side"]
    if not isinstance(side, str) or side not in EYES.values():
        raise ProfileError("eye_side", _shown(side), " or ".join(EYES.values()))
    if side not in sides:
        raise ProfileError(
            "eye_side", f"the file has no lens for the {_eye_name(side)}", sides[0]
        )
    return side, True


def _eye_name(side: str) -> str:
    return next(f"{eye} eye" for eye, known in EYES.items() if known == side)


def _powers(lens: Mapping[str, Any], where: str) -> dict[str, float]:
    """Return the fields of a prescription that a lens has."""
    sphere, power = (_number(lens, field, where) for field in ("sphere", "power"))
    if sphere is not None and power is not None and sphere != power:
        raise ProfileError(
            f"{where}.power", f"{power:g} is not the sphere, {sphere:g}", "one of both"
        )
    if sphere is None:
        sphere = power
    cylinder = _number(lens, "cylinder", where)
    if sphere is None:
        if cylinder is None:
            raise ProfileError(f"{where}.sphere", "is missing", "a power in diopters")
        sphere = 0.0
    found = {"sphere_dpt": sphere}
    axis, add = _number(lens, "axis", where), _number(lens, "add", where)
    if cylinder:
        found["cylinder_dpt"] = cylinder
        if axis is None:
            raise ProfileError(
                f"{where}.axis", "is missing beside a cylinder", "0 to 180"
            )
        if not 0.0 <= axis <= 180.0:
            raise ProfileError(f"{where}.axis", f"{axis:g}", "0 to 180")
        found["axis_deg"] = axis
    elif axis and cylinder is None:
        raise ProfileError(
            f"{where}.cylinder", "is missing beside an axis", "a power in diopters"
        )
    if add:
        found["add_dpt"] = add
    return found


def _is_contact(lens: Mapping[str, Any], where: str) -> bool:
    """Return whether a lens is a contact lens: by its product, or its power."""
    product = lens.get("product", {})
    codings = product.get("coding", []) if isinstance(product, Mapping) else None
    if not isinstance(codings, list):
        raise ProfileError(f"{where}.product", _shown(product), "a CodeableConcept")
    codes = [coding.get("code") for coding in codings if isinstance(coding, Mapping)]
    return CONTACT in codes or "power" in lens


def _prism_notes(lens: Mapping[str, Any], where: str) -> list[str]:
    prisms = lens.get("prism", [])
    allowed = f"a list of up to {MAX_PRISMS} objects with amount and base"
    if not isinstance(prisms, list) or len(prisms) > MAX_PRISMS:
        raise ProfileError(f"{where}.prism", _shown(prisms), allowed)
    descriptions = []
    for number, prism in enumerate(prisms):
        at = f"{where}.prism.{number}"
        if not isinstance(prism, Mapping):
            raise ProfileError(at, _shown(prism), "an object with amount and base")
        amount, base = _number(prism, "amount", at), prism.get("base")
        if amount is None:
            raise ProfileError(f"{at}.amount", "is missing", "prism diopters")
        if not isinstance(base, str) or base not in BASES:
            raise ProfileError(f"{at}.base", _shown(base), " or ".join(BASES))
        descriptions.append(f"{amount:g} prism dpt base {base}")
    if not descriptions:
        return []
    return [f"a prism does not blur and is left out: {', '.join(descriptions)}"]


def _number(part: Mapping[str, Any], name: str, where: str) -> float | None:
    """Return a number, or None."""
    value = part.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ProfileError(f"{where}.{name}", _shown(value), "a number")
    return float(value)


def _shown(value: object) -> str:
    return f"{value!r:.{MAX_SHOWN}}" if value is not None else "is missing"
