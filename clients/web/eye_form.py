"""Entries of one eye and of its correction, and the resulting profile.

Independent of the page: texts go in, a profile or error messages come out.
"""

from __future__ import annotations

import copy
import math
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from clients.web.controls import (
    ABERRATION,
    BIFOCAL_ADD,
    CORRECTION,
    CORRIDOR,
    CYLINDER,
    EDOF_ADD,
    MIDDLE_ADD,
    NEAR_ADD,
    PRESCRIPTION,
    PROGRESSIVE_ADD,
    SPHERE,
    VERTEX,
    NumberField,
    initial_texts,
)
from estimator import (
    MAX_PROFILE_BYTES,
    PROFILE_SUFFIXES,
    InvalidFile,
    load_profile,
    parse_profile,
    preset_names,
    profile_body,
)

EyeSide = Literal["OD", "OS"]
Source = Literal["prescription", "preset", "file"]
SIDES: dict[EyeSide, str] = {"OD": "Right eye", "OS": "Left eye"}

PRESET_TITLES = {
    "emmetropia": "Emmetropia (normal)",
    "myopia": "Myopia",
    "astigmatism": "Astigmatism",
    "keratoconus": "Keratoconus",
    "cataract": "Cataract",
    "post_lasik": "After LASIK",
}

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
ENTERED = {"kind", "higher_order", "eye_side", "age_years", "name"} | {
    field.name for field in PRESCRIPTION
}
"""Fields of a prescription that the page has entries for, or sets itself."""

TRIFOCAL_LIGHT = (0.43, 0.17, 0.26)
"""Light of a trifocal lens at far, intermediate and near: 50:20:30 of 86 %."""

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
    texts: dict[str, str] = field(default_factory=lambda: initial_texts(CORRECTION))
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

    def take(self, body: Mapping[str, Any]) -> None:
        """Set the entries from a correction, or keep it as a file if they cannot."""
        kind, design = body.get("kind", "spectacles"), body.get("design", "monofocal")
        values = dict(body)
        if design == "trifocal" and values.pop("light_ratio", 0) == [*TRIFOCAL_LIGHT]:
            adds = values.pop("adds_dpt", ())
            values |= dict(zip((MIDDLE_ADD.name, NEAR_ADD.name), adds, strict=False))
        known: tuple[NumberField, ...] | None = None
        if kind in KINDS and design in DESIGNS:
            known = CorrectionForm(kind, design).entries
        names = {entry.name for entry in known or ()}
        if known is None or not set(values) <= {"kind", "design"} | names:
            self.kind, self.file_body = "file", dict(body)
            return
        self.kind, self.design = kind, design
        absent = initial_texts(CORRECTION) | {VERTEX.name: VERTEX.show(0.0)}
        for entry in known:
            value = values.get(entry.name)
            shown = absent[entry.name] if value is None else entry.show(value)
            self.texts[entry.name] = shown


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
    entries: Sequence[NumberField], texts: Mapping[str, str], where: str = ""
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


def preset_titles() -> dict[str, str]:
    """Return the title of each preset by name."""
    return {
        name: PRESET_TITLES.get(name, name.replace("_", " ").capitalize())
        for name in preset_names()
    }


class NoFile(ValueError):
    """Raised when the source is a file and no file was uploaded."""


@dataclass
class EyeForm:
    """The entries of one eye.

    Attributes
    ----------
    side : "OD" or "OS"
    source : kind of entries in use
    texts : the prescription as typed, by field name
    has_higher_order : whether to add the typical aberrations of the age
    preset : preset name
    file_body : profile from a file, or None
    file_name : name of that file
    loaded_name : name of the file that the entries were loaded from, or empty
    wears_correction : whether `worn` applies
    """

    side: EyeSide
    source: Source = "prescription"
    texts: dict[str, str] = field(default_factory=lambda: initial_texts(PRESCRIPTION))
    has_higher_order: bool = True
    preset: str = "myopia"
    file_body: dict[str, Any] | None = None
    file_name: str = ""
    loaded_name: str = ""
    wears_correction: bool = False
    worn: CorrectionForm = field(default_factory=CorrectionForm)

    def body(self, *, age_years: float) -> dict[str, Any]:
        """Return the profile.

        Raises
        ------
        ValueError
            If an entry is invalid; the message contains its value and the range.
        """
        body = {**self._source_body(), "age_years": age_years, "eye_side": self.side}
        if self.wears_correction:
            body["correction"] = self.worn.body()
            if self.worn.kind == "iol":  # no natural lens, no typical aberrations
                body.pop("higher_order", None)
        parse_profile(body)
        return body

    def _source_body(self) -> dict[str, Any]:
        if self.source == "preset":
            return {"kind": "preset", "name": self.preset}
        if self.source == "file":
            if self.file_body is None:
                raise NoFile(f"no file yet; allowed: {', '.join(PROFILE_SUFFIXES)}")
            return dict(self.file_body)
        return {
            "kind": "prescription",
            "higher_order": "typical" if self.has_higher_order else "none",
            **read_numbers(PRESCRIPTION, self.texts),
        }

    def correct_fully(self) -> None:
        """Wear the prescription, keeping the kind of lens and its addition."""
        if not self.wears_correction or self.worn.kind not in DISTANCE_KINDS:
            self.worn.kind = "spectacles"
        self.worn.fill_distance(self.texts)
        self.wears_correction = True

    def choose_worn(self, kind: WornKind) -> None:
        """Select a kind of lens; without power, it gets the prescription's power."""
        self.worn.kind = kind
        if kind in ("progressive", "lenslets") and self.source == "prescription":
            with suppress(ValueError):  # an invalid entry stays
                powers = [e.read(self.worn.texts[e.name]) for e in (SPHERE, CYLINDER)]
                if not any(powers):
                    self.worn.fill_distance(self.texts)

    def reset(self) -> None:
        """Set the initial entries; the uploaded file stays available."""
        new = EyeForm(self.side, file_body=self.file_body, file_name=self.file_name)
        vars(self).update(vars(new))

    def copy(self, other: EyeForm) -> None:
        """Copy the entries of the other eye."""
        vars(self).update(vars(copy.deepcopy(other)) | {"side": self.side})

    def load_body(self, body: Mapping[str, Any], name: str) -> None:
        """Load the entries from a profile."""
        body = dict(body)
        is_file = Path(name).suffix.lower() in PROFILE_SUFFIXES
        self.loaded_name = name if is_file else ""
        correction = body.pop("correction", None)
        if correction is not None:
            self.wears_correction = True
            self.worn.take(correction)
        if body.get("kind") == "preset":
            self.source, self.preset = "preset", body["name"]
        elif body.get("kind") == "prescription" and set(body) <= ENTERED:
            self.source = "prescription"
            self.texts = {e.name: e.show(body.get(e.name, 0.0)) for e in PRESCRIPTION}
            self.has_higher_order = body.get("higher_order", "typical") == "typical"
        else:
            self.source, self.file_body, self.file_name = "file", body, name


def read_profile_file(name: str, content: bytes) -> dict[str, Any]:
    """Return the profile in an uploaded file.

    Raises
    ------
    InvalidFile
        If the file is of another kind, too large or not a profile.
    """
    suffix, shown = Path(name).suffix.lower(), Path(name).name[:60]
    if suffix not in PROFILE_SUFFIXES:
        allowed = ", ".join(PROFILE_SUFFIXES)
        raise InvalidFile(shown, "not a profile", allowed)
    if len(content) > MAX_PROFILE_BYTES:
        found = f"{len(content) / 1e6:.1f} MB"
        raise InvalidFile(shown, found, f"{MAX_PROFILE_BYTES / 1e6:g} MB")
    with tempfile.TemporaryDirectory(prefix="ocufilter-") as folder:
        path = Path(folder) / f"profile{suffix}"
        path.write_bytes(content)
        try:
            body = profile_body(path)
            load_profile(path)  # validates the fields
        except InvalidFile as error:
            raise InvalidFile(shown, error.found, error.allowed) from None
    if body.get("name") == path.name:  # coefficient files are named after the file
        body["name"] = shown
    return body
