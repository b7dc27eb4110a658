"""Entries of a correction, and the profile fields that result from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

from clients.web.numbers import NumberField

WornKind = Literal[
    "spectacles", "progressive", "lenslets", "contact_lens", "iol", "file"
]

KINDS: dict[WornKind, str] = {
    "spectacles": "Spectacles",
    "progressive": "Progressive spectacles",
    "lenslets": "Spectacles with lenslets",
    "contact_lens": "Contact lens",
    "iol": "Intraocular lens",
}
AS_IN_FILE = "As in the file"
DESIGNS = {
    "monofocal": "Monofocal",
    "bifocal": "Bifocal",
    "trifocal": "Trifocal",
    "edof": "Extended depth of focus",
}
HINTS: dict[WornKind, str] = {
    "progressive": "“Look: Reading” turns the gaze to the end of the corridor; use the "
    "gaze sliders to look through other parts of the lens.",
    "lenslets": "396 lenslets around a clear center; use the gaze sliders to look "
    "through other parts.",
    "iol": "Replaces the natural lens: enter the refraction that remains after surgery "
    "above. Accommodation and age-typical aberrations are not applied. Powers apply at "
    "the lens.",
}

SPHERE = NumberField("sphere_dpt", "Sphere", "dpt", -30.0, 30.0, 0.25, is_signed=True)
CYLINDER = NumberField(
    "cylinder_dpt", "Cylinder", "dpt", -15.0, 15.0, 0.25, is_signed=True
)
AXIS = NumberField("axis_deg", "Axis", "°", 0.0, 180.0, 1.0, digits=0)
VERTEX = NumberField("vertex_mm", "Vertex", "mm", 0.0, 25.0, 1.0, digits=0)
PRESCRIPTION = (SPHERE, CYLINDER, AXIS, VERTEX)

PROGRESSIVE_ADD = NumberField(
    "add_dpt", "Addition", "dpt", 0.25, 4.0, 0.25, is_signed=True
)
CORRIDOR = NumberField("corridor_mm", "Corridor", "mm", 8.0, 24.0, 1.0, digits=0)
BIFOCAL_ADD = NumberField("add_dpt", "Addition", "dpt", 0.5, 6.0, 0.25, is_signed=True)
EDOF_ADD = NumberField("add_dpt", "Addition", "dpt", 0.25, 3.0, 0.25, is_signed=True)
MIDDLE_ADD = NumberField(
    "middle_add_dpt", "Middle add", "dpt", 0.5, 6.0, 0.01, is_signed=True
)
NEAR_ADD = NumberField(
    "near_add_dpt", "Near add", "dpt", 0.5, 6.0, 0.01, is_signed=True
)
ABERRATION = NumberField(
    *("spherical_aberration_um", "C(4,0), 6 mm", "µm", -2.0, 2.0, 0.01),
    is_signed=True,
)

FIELDS_BY_KIND: dict[WornKind, tuple[NumberField, ...]] = {
    "spectacles": PRESCRIPTION,
    "progressive": (*PRESCRIPTION, PROGRESSIVE_ADD, CORRIDOR),
    "lenslets": PRESCRIPTION,
    "contact_lens": (*PRESCRIPTION[:3], ABERRATION),
    "iol": (*PRESCRIPTION[:3], ABERRATION),
    "file": (),
}
FIELDS_BY_DESIGN: dict[str, tuple[NumberField, ...]] = {
    "monofocal": (),
    "bifocal": (BIFOCAL_ADD,),
    "trifocal": (MIDDLE_ADD, NEAR_ADD),
    "edof": (EDOF_ADD,),
}
TRIFOCAL_LIGHT = (0.43, 0.17, 0.26)
"""Light of a trifocal lens at far, intermediate and near: 50:20:30 of 86 %."""


def default_texts() -> dict[str, str]:
    """Return the default texts of the entries."""
    return {
        "sphere_dpt": "0.00",
        "cylinder_dpt": "0.00",
        "axis_deg": "0",
        "vertex_mm": "12",
        "add_dpt": "+2.00",
        "corridor_mm": "14",
        "middle_add_dpt": "+1.66",
        "near_add_dpt": "+3.32",
        "spherical_aberration_um": "0.00",
    }


DISTANCE_KINDS: tuple[WornKind, ...] = (
    *("spectacles", "progressive", "lenslets", "contact_lens"),
)
"""Kinds that can take their distance powers from the prescription."""

MM_PER_M = 1000.0
ROTATION_CENTER_MM = 13.5
"""Depth of the eye's center of rotation behind the cornea."""


def reading_gaze_deg(profile: Mapping[str, Any]) -> float | None:
    """Return the vertical gaze through the end of a progressive lens's corridor.

    Rounded down to a whole degree; None for other corrections.
    """
    worn = profile.get("correction") or {}
    if worn.get("kind") != "progressive":
        return None
    depth_mm = worn["vertex_mm"] + ROTATION_CENTER_MM
    return math.floor(-math.degrees(math.atan2(worn["corridor_mm"], depth_mm)))


def depends_on_gaze(profile: Mapping[str, Any]) -> bool:
    """Return whether the gaze selects the part of the correction in use."""
    worn = profile.get("correction") or {}
    return worn.get("kind") in ("progressive", "lenslets")


def profile_for_gaze(
    profile: Mapping[str, Any], gaze_deg: tuple[float, float]
) -> dict[str, Any]:
    """Return a profile with its correction at a gaze."""
    if not depends_on_gaze(profile):
        return dict(profile)
    worn = dict(profile["correction"])
    own_deg = worn.get("gaze_deg", (0.0, 0.0))
    worn["gaze_deg"] = [own + more for own, more in zip(own_deg, gaze_deg, strict=True)]
    return {**profile, "correction": worn}


@dataclass
class CorrectionForm:
    """The entries of one eye's correction.

    Attributes
    ----------
    design : of an intraocular lens
    texts : as typed, by field name
    file_body : a correction that the entries cannot represent, or None
    """

    kind: WornKind = "spectacles"
    design: str = "monofocal"
    texts: dict[str, str] = field(default_factory=default_texts)
    file_body: dict[str, Any] | None = None

    @property
    def kinds(self) -> dict[WornKind, str]:
        """Return the kinds that can be selected."""
        return KINDS if self.file_body is None else {**KINDS, "file": AS_IN_FILE}

    @property
    def entries(self) -> tuple[NumberField, ...]:
        """Return the entries in use."""
        more = FIELDS_BY_DESIGN[self.design] if self.kind == "iol" else ()
        return (*more, *FIELDS_BY_KIND[self.kind])

    def body(self) -> dict[str, Any]:
        """Return the correction.

        Raises
        ------
        ValueError
            If an entry is invalid; the message names it, its value and the range.
        """
        if self.kind == "file":
            return dict(self.file_body or {})
        values = read_numbers(self.entries, self.texts, "Worn correction: ")
        if self.kind == "spectacles":
            return dict(values)
        found: dict[str, Any] = {"kind": self.kind, **values}
        if self.kind != "iol":
            return found
        if self.design == "trifocal":
            adds = [found.pop(entry.name) for entry in FIELDS_BY_DESIGN["trifocal"]]
            found |= {"adds_dpt": adds, "light_ratio": list(TRIFOCAL_LIGHT)}
        return found | {"design": self.design}

    def fill_distance(self, texts: Mapping[str, str]) -> None:
        """Set the distance powers from the entries of a prescription."""
        self.texts |= {entry.name: texts[entry.name] for entry in PRESCRIPTION}
        if self.kind == "contact_lens":
            with suppress(ValueError):  # reported at the prescription
                self.texts |= _texts_at_cornea(read_numbers(PRESCRIPTION, texts))

    @property
    def is_plano(self) -> bool:
        """Return whether sphere and cylinder are zero."""
        try:
            return not any(e.read(self.texts[e.name]) for e in (SPHERE, CYLINDER))
        except ValueError:
            return False

    def take(self, body: Mapping[str, Any]) -> None:
        """Set the entries from a correction, or keep it as a file if they cannot."""
        kind, design = body.get("kind", "spectacles"), body.get("design", "monofocal")
        values = dict(body)
        names: list[str] | set[str]
        if design == "trifocal" and values.pop("light_ratio", 0) == [*TRIFOCAL_LIGHT]:
            names = [entry.name for entry in FIELDS_BY_DESIGN["trifocal"]]
            values |= dict(zip(names, values.pop("adds_dpt", ()), strict=False))
        known = (
            CorrectionForm(kind, design)
            if kind in KINDS and design in DESIGNS
            else None
        )
        names = {entry.name for entry in known.entries} if known else set()
        if known is None or not set(values) <= {"kind", "design"} | names:
            self.kind, self.file_body = "file", dict(body)
            return
        self.kind, self.design = known.kind, known.design
        missing = {"vertex_mm": 0.0} if "vertex_mm" in names else {}
        for entry in known.entries:
            value = values.get(entry.name, missing.get(entry.name))
            text = default_texts()[entry.name] if value is None else entry.show(value)
            self.texts[entry.name] = text

    def copied(self) -> CorrectionForm:
        """Return a copy for the other eye."""
        return CorrectionForm(self.kind, self.design, dict(self.texts), self.file_body)


def _texts_at_cornea(lens: Mapping[str, float]) -> dict[str, str]:
    """Return the texts of sphere and cylinder with the vertex distance removed."""
    vertex_m = lens[VERTEX.name] / MM_PER_M
    sphere_dpt, other_dpt = (
        power_dpt / (1.0 - vertex_m * power_dpt)
        for power_dpt in (
            lens[SPHERE.name],
            lens[SPHERE.name] + lens[CYLINDER.name],
        )
    )
    return {
        SPHERE.name: SPHERE.show(sphere_dpt),
        CYLINDER.name: CYLINDER.show(other_dpt - sphere_dpt),
    }


def read_numbers(
    entries: tuple[NumberField, ...], texts: Mapping[str, str], where: str = ""
) -> dict[str, float]:
    """Return the numbers of entries.

    Raises
    ------
    ValueError
        If an entry is invalid; the message names the entry, its value and the allowed
        range.
    """
    values = {}
    for entry in entries:
        try:
            values[entry.name] = entry.read(texts[entry.name])
        except ValueError as error:
            raise ValueError(f"{where}{entry.label}: {error}") from None
    return values
