"""Numbers of a prescription as people write them: plano, -2.50DS, x 80, 1.2 cm."""

from __future__ import annotations

import math
import re

DIOPTERS, MILLIMETERS, DEGREE = "dpt", "mm", "°"
MINUS_SIGNS = str.maketrans({"\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", ",": "."})

MM = {"": 1.0, "mm": 1.0, "cm": 10.0}
LEAST_VERTEX_MM = 5.0
"""Spectacles are farther from the eye; a smaller number may be in centimeters."""

_FLAGS = re.IGNORECASE | re.ASCII
_PLANO = r"(?:plano|plan|pl\.?|neutral)"
_NUMBER = r"[+-]?\s?(?:\d+(?:\.\d*)?|\.\d+)"
_DPT = r"(?:\s*(?:ds|dc|dpt|d|sph|cyl|sphere|cylinder)\b\.?)?"
_POWER = re.compile(rf"(?:({_NUMBER}){_DPT}|{_PLANO}{_DPT})", _FLAGS)
_ANGLE = re.compile(
    r"(?:x|×|\*|@|ax(?:is|e)?\.?)?\s*(\d+(?:\.\d+)?)\s*(?:°|deg)?", _FLAGS
)
_LENGTH = re.compile(rf"({_NUMBER})\s*(mm|cm)?", _FLAGS)
_PRISM = re.compile(
    r"(?:\u0394|\u2206|\bprism|\bpd\b|\d\s*p\.?d\.?\b|\bb(?:ase)?[\s.]*(?:up|down|in|out|[udio])\b)",
    re.IGNORECASE,
)
_ADDITION = re.compile(r"\badd(?:ition)?\b", _FLAGS)

_ENTRY = rf"({_NUMBER}|{_PLANO}){_DPT}"
_PRESCRIPTION = re.compile(
    rf"{_ENTRY}\s*(?:[/;]\s*|\s+|(?=[+-])){_ENTRY}\s*"
    r"(?:[x×*@/;]|ax(?:is|e)?\.?|\s)\s*(\d{1,3})\s*(?:°|deg)?",
    _FLAGS,
)
_START = re.compile(rf"{_ENTRY}\s*(?:[/;]|\s|[+-]).*", _FLAGS)
_AXIS = r"\s*(?:[x×*@]|ax(?:is|e)?\.?)\s*(\d{1,3})\s*(?:°|deg)?"
_ONE_POWER = re.compile(_ENTRY + _AXIS, _FLAGS)
NO_CYLINDER = ("ds", "sph", "sphere")
"""Texts in place of a cylinder of 0."""

_SPHERE_ALONE = re.compile(rf"({_NUMBER}|{_PLANO})\s*(?:ds|sph|sphere)\b\.?", _FLAGS)


def written_number(text: str, *, unit: str, is_vertex: bool = False) -> float:
    """Return the number in an entry; a comma may be the decimal point.

    Parameters
    ----------
    unit : str
        Unit of the entry: "dpt", "mm", "°" or another one.
    is_vertex : bool
        Whether it is the distance of spectacles from the cornea, for which a number
        without a unit may be meant in centimeters.

    Returns
    -------
    float
        NaN if the text is not a number.

    Raises
    ------
    ValueError
        If the text contains a prism or an addition, or its unit is ambiguous.
    """
    plain = text.strip().translate(MINUS_SIGNS)
    if unit == DIOPTERS:
        return _power_dpt(plain)
    if unit == MILLIMETERS:
        return _length_mm(plain, is_vertex=is_vertex)
    if unit == DEGREE and (found := _ANGLE.fullmatch(plain)):
        return float(found[1])
    try:
        return float(plain)
    except ValueError:
        return math.nan


def _power_dpt(plain: str) -> float:
    if _PRISM.search(plain):
        raise ValueError(
            f"“{plain:.30}” contains a prism, which is not modeled: leave it out"
        )
    if _ADDITION.search(plain):
        raise ValueError(
            f"“{plain:.30}” contains an addition: enter it with progressive "
            "spectacles, and leave it out here"
        )
    found = _POWER.fullmatch(plain)
    if found is None:
        return math.nan
    return float(found[1].replace(" ", "")) if found[1] else 0.0


def _length_mm(plain: str, *, is_vertex: bool) -> float:
    found = _LENGTH.fullmatch(plain)
    if found is None:
        return math.nan
    unit = (found[2] or "").lower()
    value_mm = float(found[1].replace(" ", "")) * MM[unit]
    if is_vertex and not unit and 0.0 < value_mm < LEAST_VERTEX_MM:
        raise ValueError(
            f"{plain:.20} mm is too near for spectacles: write “{value_mm:g} cm” or "
            f"“{value_mm:g} mm”; usual are 12 to 14 mm"
        )
    return value_mm


def prescription_texts(text: str) -> tuple[str, str, str] | None:
    """Return sphere, cylinder and axis of a text as "-3.5 -1.25 x 80" or "-2.50 DS".

    None if the text has another form.
    """
    plain = text.strip().translate(MINUS_SIGNS)
    alone = _SPHERE_ALONE.fullmatch(plain)
    if alone is not None:
        return _digits(alone[1]), "0", "0"
    found = _PRESCRIPTION.fullmatch(plain)
    if found is None:
        return None
    return _digits(found[1]), _digits(found[2]), found[3]


def begins_prescription(text: str) -> bool:
    """Return whether a text may become a whole prescription as it is typed on."""
    plain = text.strip().translate(MINUS_SIGNS)
    is_other = _PRISM.search(plain) or _ADDITION.search(plain)
    return is_other is None and (
        _START.fullmatch(plain) is not None or prescription_texts(text) is not None
    )


def prescription_hint(text: str) -> str:
    """Return what a text lacks that has an axis but one power; empty otherwise."""
    found = _ONE_POWER.fullmatch(text.strip().translate(MINUS_SIGNS))
    if found is None:
        return ""
    return (
        "has an axis but one power: write sphere, cylinder and axis, as "
        f"“plano {found[1]} x {found[2]}”"
    )


def _digits(power: str) -> str:
    """Return a power without spaces; 0 for plano."""
    return re.sub(r"\s", "", power) if any(map(str.isdigit, power)) else "0"
