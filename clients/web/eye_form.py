"""Entries of one eye, and the resulting profile.

Independent of the page: texts go in, a profile or error messages come out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from clients.web.correction_form import (
    DISTANCE_KINDS,
    PRESCRIPTION,
    CorrectionForm,
    WornKind,
    read_numbers,
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
    texts: dict[str, str] = field(default_factory=lambda: _as_texts({"vertex_mm": 12}))
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
        """Select a kind of lens; without power, it takes that of the prescription."""
        self.worn.kind = kind
        is_graded = kind in ("progressive", "lenslets")
        if is_graded and self.source == "prescription" and self.worn.is_plano:
            self.worn.fill_distance(self.texts)

    def reset(self) -> None:
        """Set the initial entries; the uploaded file stays available."""
        new = EyeForm(self.side, file_body=self.file_body, file_name=self.file_name)
        vars(self).update(vars(new))

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
        elif _is_plain_prescription(body):
            self.source, self.texts = "prescription", _as_texts(body)
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


def _is_plain_prescription(body: Mapping[str, Any]) -> bool:
    known = {e.name for e in PRESCRIPTION} | {
        *("kind", "higher_order", "eye_side", "age_years", "name")
    }
    return body.get("kind") == "prescription" and set(body) <= known


def _as_texts(body: Mapping[str, Any]) -> dict[str, str]:
    return {entry.name: entry.show(body.get(entry.name, 0.0)) for entry in PRESCRIPTION}
