"""Entries of one eye and of its correction, and the resulting profile.

Independent of the page: texts go in, a profile or error messages come out.
"""

from __future__ import annotations

import copy
import math
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from clients.web.controls import (
    ABERRATION,
    AGE,
    BIFOCAL_ADD,
    CORRECTION,
    CORRIDOR,
    CYLINDER,
    EDOF_ADD,
    MIDDLE_ADD,
    NEAR_ADD,
    PRESCRIPTION,
    PROGRESSIVE_ADD,
    RESIDUAL,
    RESIDUAL_SPHERE,
    SPHERE,
    STRAYLIGHT,
    VERTEX,
    NumberField,
    initial_texts,
)
from estimator import (
    MAX_PROFILE_BYTES,
    PROFILE_SUFFIXES,
    InvalidFile,
    ProfileError,
    load_profile,
    parse_profile,
    preset_names,
    profile_body,
)
from estimator.media import Straylight

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
    "spectacles", "progressive", "lenslets", "contact_lens", "iol", "laser", "file"
]

KINDS: dict[WornKind, str] = {
    "spectacles": "Spectacles",
    "progressive": "Progressive spectacles",
    "lenslets": "Spectacles with lenslets",
    "contact_lens": "Contact lens",
    "iol": "Intraocular lens",
    "laser": "Laser surgery",
}
NO_SURGERY = (
    "Surgery cannot be computed for this file, because it describes the eye by its "
    "surfaces. Choose spectacles or a contact lens, or describe the eye before surgery "
    "by its prescription, a preset or a measured wavefront."
)
AS_LOADED = "Other, as loaded"
SURGERIES: tuple[WornKind, ...] = ("iol", "laser")
"""Kinds that change the eye of the entries above them."""

SURGERY_FIELDS = ("correction.residual_sphere_dpt", "correction.kind")
"""Fields of the error if a kind of profile allows no surgery."""

Haze = Literal[
    "none", "age", "nuclear", "cortical", "posterior_subcapsular", "measured"
]
HAZES: dict[Haze, str] = {
    "none": "None",
    "age": "Of this age",
    "nuclear": "Nuclear cataract",
    "cortical": "Cortical cataract",
    "posterior_subcapsular": "Posterior subcapsular cataract",
    "measured": "Measured",
}
Yellowing = Literal["none", "seen", "adapted"]
YELLOWINGS: dict[Yellowing, str] = {
    "none": "None",
    "seen": "Of this age",
    "adapted": "Adapted to white",
}
YOUNG_YEARS = 25.0
"""Age of the eye to which straylight is compared."""

GONE = "The cataract is gone with the natural lens; this is usual at this age. "

MILD = (
    " Published nuclear and cortical cataracts scatter, on average, no more than a "
    "healthy eye of about 70; enter a measured log s of 1.5 or more for a dense one."
)
MILD_RATIO = 1.2
"""Haze of a cataract, relative to its age, below which `MILD` explains it."""

CATARACT = "cataract"
"""Preset that has the haze of a cataract when it is selected."""

PRESET_AGES_YEARS = {CATARACT: 72.0}
"""Ages that presets set when they are selected: people at cataract surgery."""

DESIGNS = {
    "monofocal": "Monofocal",
    "bifocal": "Bifocal",
    "trifocal": "Trifocal",
    "edof": "Extended depth of focus",
}
FIELDS_BY_KIND: dict[WornKind, tuple[NumberField, ...]] = {
    "spectacles": PRESCRIPTION,
    "progressive": (*PRESCRIPTION, PROGRESSIVE_ADD, CORRIDOR),
    "lenslets": PRESCRIPTION,
    "contact_lens": (*PRESCRIPTION[:3], ABERRATION),
    "iol": (*RESIDUAL, ABERRATION),
    "laser": (*RESIDUAL, ABERRATION),
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
        return KINDS if self.file_body is None else {**KINDS, "file": AS_LOADED}

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
        is_known = kind in KINDS and design in DESIGNS
        if is_known and not _is_after_surgery(values):
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


def is_of_version_0_2(kind: str, texts: Mapping[str, Any]) -> bool:
    """Return whether a link's correction is an implant of version 0.2."""
    return kind == "iol" and RESIDUAL_SPHERE.name not in texts


def implant_of_version_0_2(design: str, texts: Mapping[str, str]) -> CorrectionForm:
    """Return the implant of a link of version 0.2, with its meaning.

    The prescription is the refraction after surgery, and the lens's own powers add to
    it.  A lens with an invalid entry becomes a new implant.
    """
    old = CorrectionForm("iol", design)
    old.texts |= texts
    try:
        body = old.body()
        powers = read_numbers(PRESCRIPTION[:3], old.texts)
    except ValueError:
        return old
    for entry in RESIDUAL:
        del body[entry.name]
    form = CorrectionForm()
    form.take(body | powers)
    return form


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
    haze : straylight of the eye
    media_texts : its parameter as typed, for "measured"
    yellowing : of the natural lens
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
    haze: Haze = "none"
    media_texts: dict[str, str] = field(
        default_factory=lambda: initial_texts((STRAYLIGHT,))
    )
    yellowing: Yellowing = "none"

    @property
    def applies_higher_order(self) -> bool:
        """Return whether the typical aberrations of the age can be applied.

        Not to a prescription that is the refraction after lens surgery.
        """
        worn = self.worn.file_body if self.worn.kind == "file" else None
        return not (self.wears_correction and _is_after_surgery(worn or {}))

    @property
    def is_before_surgery(self) -> bool:
        """Return whether the entries describe the eye before surgery."""
        return self.wears_correction and self.worn.kind in SURGERIES

    def body(self, *, age_years: float) -> dict[str, Any]:
        """Return the profile.

        Raises
        ------
        ValueError
            If an entry is invalid; the message contains its value and the range.
        """
        body = {**self._source_body(), "age_years": age_years, "eye_side": self.side}
        body |= self._media()
        if self.wears_correction:
            body["correction"] = self.worn.body()
            if not self.applies_higher_order:
                body.pop("higher_order", None)
        try:
            parse_profile(body)
        except ProfileError as error:
            is_surgery = self.wears_correction and self.worn.kind in SURGERIES
            if is_surgery and error.field in SURGERY_FIELDS:
                raise ValueError(NO_SURGERY) from None
            raise
        return body

    def _media(self) -> dict[str, Any]:
        """Return the straylight and yellowing of the entries."""
        found: dict[str, Any] = {}
        if self.haze == "measured":
            found["straylight"] = {
                STRAYLIGHT.name: STRAYLIGHT.read(self.media_texts[STRAYLIGHT.name])
            }
        elif self.haze != "none":
            is_typical = self.haze == "age"
            found["straylight"] = {} if is_typical else {"cataract": self.haze}
        if self.yellowing != "none":
            found["yellowing"] = self.yellowing
        return found

    def choose_haze(self, haze: Haze, *, age_years: float) -> None:
        """Select the straylight; a measured one starts as that of the choice before."""
        light = self._straylight(age_years=age_years)
        if haze == "measured" and light is not None:
            log_s = light.age_log_s if light.log_s is None else light.log_s
            shown = STRAYLIGHT.show(STRAYLIGHT.clamped(log_s))
            self.media_texts[STRAYLIGHT.name] = shown
        self.haze = haze

    def _straylight(self, *, age_years: float) -> Straylight | None:
        """Return the straylight of valid entries."""
        try:
            return parse_profile(self.body(age_years=age_years)).straylight
        except ValueError:  # reported at its entry
            return None

    def haze_text(self, *, age_years: float) -> str:
        """Return how much light the eye scatters, in a sentence; empty without.

        A cataract's straylight goes with the natural lens.
        """
        haze = self._straylight(age_years=age_years)
        if haze is None:
            return ""
        log_s = haze.age_log_s if haze.log_s is None else haze.log_s
        young = replace(haze, age_years=YOUNG_YEARS).age_log_s
        by_age = 10.0 ** (log_s - haze.age_log_s)
        is_cataract = self.haze not in ("none", "age", "measured")
        return GONE * (is_cataract and haze.log_s is None) + (
            f"{100.0 * haze.fraction:.0f} % of the light is scattered over the scene: "
            f"{10.0 ** (log_s - young):.1f} times as much as in a young eye, and "
            f"{by_age:.1f} times as much as is usual at this age (log s {log_s:.2f} "
            "at 7°)."
            + MILD
            * (is_cataract and haze.log_s is not None and by_age < MILD_RATIO)
        )

    def choose_preset(self, name: str, *, age_years: float) -> float:
        """Select a preset; a cataract comes with haze, a yellow lens and an age.

        Return the age of the person with the preset.
        """
        if name == CATARACT and self.preset != CATARACT:
            self.haze, self.yellowing = "posterior_subcapsular", "seen"
        elif self.preset == CATARACT and name != CATARACT:
            self.haze, self.yellowing = "none", "none"
            if age_years == PRESET_AGES_YEARS[CATARACT]:
                age_years = AGE.initial
        self.preset = name
        return PRESET_AGES_YEARS.get(name, age_years)

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
        """Select a kind of correction; its powers start as that kind needs them.

        Progressive lenses and lenslets without power get the prescription's.  After
        surgery nothing remains, until the entries say so.
        """
        if kind in SURGERIES and self.worn.kind not in SURGERIES:
            self.worn.texts |= initial_texts(RESIDUAL)
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
        self._take_media(body)
        if body.get("kind") == "preset":
            self.source, self.preset = "preset", body["name"]
        elif body.get("kind") == "prescription" and set(body) <= ENTERED:
            self.source = "prescription"
            self.texts = {e.name: e.show(body.get(e.name, 0.0)) for e in PRESCRIPTION}
            self.has_higher_order = body.get("higher_order", "typical") == "typical"
        else:
            self.source, self.file_body, self.file_name = "file", body, name

    def _take_media(self, body: dict[str, Any]) -> None:
        """Set haze and yellowing from a profile, and remove them from it.

        Straylight that the entries cannot represent stays in the profile.
        """
        self.haze, self.yellowing = "none", body.pop("yellowing", None) or "none"
        light = body.get("straylight")
        if light is None:
            body.pop("straylight", None)
        elif not light:
            self.haze = "age"
        elif set(light) == {"cataract"}:
            self.haze = light["cataract"]
        elif set(light) == {STRAYLIGHT.name}:
            self.haze = "measured"
            self.media_texts[STRAYLIGHT.name] = STRAYLIGHT.show(light[STRAYLIGHT.name])
        if self.haze != "none":
            del body["straylight"]


def _is_after_surgery(worn: Mapping[str, Any]) -> bool:
    """Return whether a correction makes a prescription that after lens surgery."""
    return worn.get("kind") == "iol" and RESIDUAL_SPHERE.name not in worn


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
