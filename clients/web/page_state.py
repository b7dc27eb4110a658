"""State of a page, independent of its layout; and its entries as text, for links.

The text is the fragment of the page's address, which browsers do not send.  It contains
the entries that differ from a new page, and never the content of a file.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from clients.web.controls import (
    AGE,
    CONDITIONS,
    DISTANCE,
    FOCUS,
    GAZE_H,
    GAZE_V,
    PUPIL,
    initial_values,
)
from clients.web.eye_form import (
    DESIGNS,
    HAZES,
    KINDS,
    SIDES,
    YELLOWINGS,
    CorrectionForm,
    EyeForm,
    EyeSide,
    NoFile,
    Source,
    implant_of_version_0_2,
    is_of_version_0_2,
    preset_titles,
    profile_for_gaze,
    read_profile_file,
    reading_gaze_deg,
)
from clients.web.filter_thread import PictureRequest
from clients.web.picture import Picture
from estimator.bounded_files import loads_bounded
from filter_service.messages import State
from filter_service.settings import Pipeline

Shown = Literal["OD", "OS", "both"]

READING_DPT = 2.5
READING_GAZE_DEG = -30.0
"""Vertical gaze for reading without a progressive lens."""

VERSION = 1
MAX_CHARACTERS = 8000
"""Length limit of a fragment; every entry of both eyes takes 1,600 characters."""

MAX_ENTRY_CHARACTERS = 40
SCENES = ("courtyard", "primitives", "chart")
"""Scenes that need no file; a new page shows the first one."""


@dataclass
class PageState:
    """The entries of one page.

    Attributes
    ----------
    values : viewing conditions by field name
    is_focus_set : whether the user set the focus, so that it ignores the distance
    picture : the scene; None until one is ready
    empty_reason : text in place of the picture, or an empty string
    shown : which eye, or both
    pipeline : pipeline of full pictures; previews are exact
    number : number of the last request
    valid_profiles : the last valid profile of each eye
    """

    eyes: dict[EyeSide, EyeForm] = field(
        default_factory=lambda: {side: EyeForm(side) for side in SIDES}
    )
    values: dict[str, float] = field(default_factory=initial_values)
    is_focus_set: bool = False
    picture: Picture | None = None
    empty_reason: str = ""
    shown: Shown = "OD"
    pipeline: Pipeline = "exact"
    number: int = 0
    valid_profiles: dict[EyeSide, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def sides(self) -> tuple[EyeSide, ...]:
        """Return the eyes that are shown."""
        return tuple(SIDES) if self.shown == "both" else (self.shown,)

    @property
    def titles(self) -> str:
        """Return the names of the eyes that are shown, in lower case."""
        return " and ".join(SIDES[side].lower() for side in self.sides)

    def body(self, side: EyeSide) -> dict[str, Any]:
        """Return an eye's profile.

        Raises
        ------
        ValueError
            An invalid entry: its value and the allowed ones.
        """
        return self.eyes[side].body(age_years=self.values[AGE.name])

    def problems(self) -> list[str]:
        """Return the errors in the entries of the eyes shown."""
        found = []
        for side in self.sides:
            try:
                self.body(side)
            except NoFile:
                continue  # not an error: the upload shows what is allowed
            except ValueError as error:
                found.append(f"{SIDES[side]}: {error}")
        return found

    @property
    def eye_state(self) -> dict[str, float]:
        """Return pupil and focus, as arguments of filters and figures."""
        return {number.name: self.values[number.name] for number in (PUPIL, FOCUS)}

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to straight ahead of the head."""
        return self.values[GAZE_H.name], self.values[GAZE_V.name]

    @property
    def picture_gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to the picture's center."""
        follows = self.picture is not None and self.picture.follows_gaze
        return (0.0, 0.0) if follows else self.gaze_deg

    def profile_at_gaze(self, side: EyeSide) -> dict[str, Any] | None:
        """Return an eye's last valid profile, with its correction at the gaze."""
        body = self.valid_profiles.get(side)
        return None if body is None else profile_for_gaze(body, self.gaze_deg)

    def set_picture(self, picture: Picture) -> None:
        """Set the picture; the first one also sets its initial focus and pupil."""
        if self.picture is None:
            for number in (FOCUS, PUPIL):
                value = getattr(picture, number.name)
                if value is not None:
                    shown = round(value, number.digits)
                    self.values[number.name] = min(shown, number.high)
        self.picture = picture
        if picture.distance_dpt is not None:
            self.values[DISTANCE.name] = picture.distance_dpt
            self._focus_on_picture()

    def _focus_on_picture(self) -> None:
        is_flat = self.picture is not None and self.picture.distance_dpt is not None
        if is_flat and not self.is_focus_set:
            self.values[FOCUS.name] = min(self.values[DISTANCE.name], FOCUS.high)

    def move(self, name: str, value: float) -> None:
        """Set a viewing condition.

        The focus follows the distance of a flat picture until the user sets it.
        """
        self.values[name] = value
        if name == FOCUS.name:
            self.is_focus_set = True
        elif name == DISTANCE.name:
            self._focus_on_picture()

    def look(self, *, is_reading: bool) -> None:
        """Look straight ahead and far, or down at a reading distance."""
        bodies = (self.valid_profiles.get(side, {}) for side in self.sides)
        turns_deg = [turn for body in bodies if (turn := reading_gaze_deg(body))]
        gaze_deg = max(min([*turns_deg, 0.0]) or READING_GAZE_DEG, GAZE_V.low)
        distance_dpt = READING_DPT if is_reading else 0.0
        self.values |= {
            GAZE_H.name: 0.0,
            GAZE_V.name: gaze_deg if is_reading else 0.0,
            DISTANCE.name: distance_dpt,
            FOCUS.name: distance_dpt,
        }
        self.is_focus_set = False

    def load_body(self, side: EyeSide, body: Mapping[str, Any], name: str) -> None:
        """Load a profile into an eye, with the age of the person."""
        self.eyes[side].load_body(body, name)
        self.values[AGE.name] = body.get(AGE.name, self.values[AGE.name])

    def load_file(self, side: EyeSide, name: str, content: bytes) -> EyeSide:
        """Load a profile file into the eye that it names, by default into `side`.

        Returns
        -------
        The eye that was loaded.

        Raises
        ------
        ValueError
            Not a profile; nothing has changed.
        """
        body = read_profile_file(name, content)
        loaded_side: EyeSide = body.get("eye_side", side)
        self.load_body(loaded_side, body, Path(name).name)
        if loaded_side != side and self.eyes[side].file_body is None:
            self.eyes[side].source = "prescription"
        return loaded_side

    def reset(self) -> None:
        """Set the initial entries; picture and uploaded files stay available."""
        for form in self.eyes.values():
            form.reset()
        self.values.update(initial_values())
        self.shown, self.is_focus_set, self.pipeline = "OD", False, "exact"

    def read_profiles(self) -> bool:
        """Read the profiles of the eyes shown; return whether any has changed.

        An eye with an invalid entry keeps its last profile: see `problems`.
        """
        before = dict(self.valid_profiles)
        for side in self.sides:
            try:
                self.valid_profiles[side] = self.body(side)
            except ValueError:
                continue
        return self.valid_profiles != before

    def request(self) -> PictureRequest | None:
        """Return the request for the current state; None without a picture or eye."""
        self.read_profiles()
        shown = [side for side in self.sides if side in self.valid_profiles]
        if self.picture is None or not shown:
            return None
        self.picture = self.picture.at(self.values[DISTANCE.name])
        bodies = {side: self.valid_profiles[side] for side in shown}
        if self.picture.follows_gaze:
            bodies = {s: profile_for_gaze(bodies[s], self.gaze_deg) for s in shown}
        self.number += 1
        return PictureRequest(
            number=self.number,
            picture=self.picture,
            bodies=bodies,
            state=State(**self.eye_state, gaze_deg=self.picture_gaze_deg),
            pipeline=self.pipeline,
        )

    def look_at(self, x: float, y: float) -> None:
        """Focus on the scene point at a position in the picture."""
        if self.picture is not None:
            distance_dpt = self.picture.scene_point(x, y).distance_dpt
            focus_dpt = round(distance_dpt, FOCUS.digits)
            self.move(FOCUS.name, min(focus_dpt, FOCUS.high))


def fragment_of(state: PageState, scene: str) -> str:
    """Return the entries as the fragment of an address, without ``#``."""
    changes = _changes(_entries(state, scene), _entries(PageState(), SCENES[0]))
    text = json.dumps({"v": VERSION, **changes}, separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _entries(state: PageState, scene: str) -> dict[str, Any]:
    return {
        "shown": state.shown,
        "pipeline": state.pipeline,
        "scene": scene if scene in SCENES else SCENES[0],
        "focus_set": state.is_focus_set,
        "values": {name: round(value, 4) for name, value in state.values.items()},
        "eyes": {side: _eye_entries(form) for side, form in state.eyes.items()},
    }


def _eye_entries(form: EyeForm) -> dict[str, Any]:
    worn = form.worn
    entries = {"kind": worn.kind, "design": worn.design, "texts": worn.texts}
    is_file = form.source == "file"
    return {
        "source": form.source,
        "file": form.file_name[:MAX_ENTRY_CHARACTERS] if is_file else None,
        "preset": form.preset,
        "higher_order": form.has_higher_order,
        "haze": form.haze,
        "media": form.media_texts,
        "yellowing": form.yellowing,
        "texts": form.texts,
        "correction": entries if form.wears_correction else {},
    }


def _changes(entries: Mapping[str, Any], initial: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries that differ from the initial ones, at any depth."""
    return {
        name: _changes(value, initial[name])
        if isinstance(value, dict) and name in initial
        else value
        for name, value in entries.items()
        if value != initial.get(name)
    }


class Restored(NamedTuple):
    """Result of reading a link.

    Attributes
    ----------
    scene : str or None
        Scene to show; None if the fragment contains no entries for a page.
    problems : list of str
        Sentences about rejected entries of the link.
    """

    scene: str | None
    problems: list[str]


def restore(state: PageState, fragment: str) -> Restored:
    """Set a page's entries from a fragment; report rejected entries.

    Entries are validated like typed ones.  Invalid and missing ones get their initial
    values.
    """
    entries = _read(fragment)
    if entries is None:
        text = "The link contains no entries for this page; it may be incomplete."
        return Restored(None, [text])
    state.reset()
    state.is_focus_set = entries.get("focus_set") is True
    state.shown = _choice(entries, "shown", get_args(Shown)) or state.shown
    state.pipeline = _choice(entries, "pipeline", get_args(Pipeline)) or state.pipeline
    problems = []
    values = state.values | _mapping(entries, "values")
    for number in CONDITIONS:
        value = values[number.name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            problem: str | None = f"{_short(value)} is not a number"
        else:
            problem = number.problem(f"{value:g}")
        if problem:
            problems.append(f"{number.label}: {problem}.")
        else:
            state.values[number.name] = float(value)
    eyes = _mapping(entries, "eyes")
    for side, title in SIDES.items():
        found = _restore_eye(state.eyes[side], _mapping(eyes, side))
        problems += [f"{title}: {problem}." for problem in found]
    return Restored(_choice(entries, "scene", SCENES) or SCENES[0], problems)


def _read(fragment: str) -> dict[str, Any] | None:
    if len(fragment) > MAX_CHARACTERS:
        return None
    try:
        padded = fragment + "=" * (-len(fragment) % 4)
        text = base64.urlsafe_b64decode(padded)
        entries = loads_bounded(text, max_bytes=MAX_CHARACTERS, finite=True)
    except ValueError:
        return None
    if not isinstance(entries, dict) or entries.get("v") != VERSION:
        return None
    return entries


def _mapping(entries: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an entry that is a mapping; an empty one if it is missing or another."""
    value = entries.get(name)
    return value if isinstance(value, dict) else {}


def _choice(entries: Mapping[str, Any], name: str, options: Collection[str]) -> Any:
    """Return an entry that is one of some texts; None if it is missing or another."""
    value = entries.get(name)
    return value if isinstance(value, str) and value in options else None


def _short(value: object) -> str:
    return f"{value!r:.30}"


def _restore_eye(form: EyeForm, entries: dict[str, Any]) -> list[str]:
    problems = []
    source = _choice(entries, "source", get_args(Source))
    if source == "file":
        name = str(entries.get("file", ""))[:MAX_ENTRY_CHARACTERS]
        if form.file_body is None or form.file_name[:MAX_ENTRY_CHARACTERS] != name:
            source = None
            problems.append(
                f"the profile file {name!r} is not part of a link; upload it"
            )
    form.source = source or form.source
    form.preset = _choice(entries, "preset", preset_titles()) or form.preset
    if entries.get("preset", form.preset) != form.preset:
        problems.append(f"preset {_short(entries['preset'])} is unknown")
    form.has_higher_order = entries.get("higher_order") is not False
    form.haze = _choice(entries, "haze", HAZES) or form.haze
    problems += _restore_texts(form.media_texts, _mapping(entries, "media"))
    form.yellowing = _choice(entries, "yellowing", YELLOWINGS) or form.yellowing
    problems += _restore_texts(form.texts, _mapping(entries, "texts"))
    correction = _mapping(entries, "correction")
    if correction:
        form.wears_correction, form.worn = True, CorrectionForm()
        form.worn.kind = _choice(correction, "kind", KINDS) or form.worn.kind
        if correction.get("kind") != form.worn.kind:
            problems.append(f"correction {_short(correction.get('kind'))} is unknown")
        form.worn.design = _choice(correction, "design", DESIGNS) or form.worn.design
        problems += _restore_texts(form.worn.texts, _mapping(correction, "texts"))
        if is_of_version_0_2(form.worn.kind, _mapping(correction, "texts")):
            form.worn = implant_of_version_0_2(form.worn.design, form.worn.texts)
    return problems


def _restore_texts(texts: dict[str, str], entries: dict[str, Any]) -> list[str]:
    """Set known entries; the form reports invalid texts, as it does typed ones."""
    problems = []
    for name in texts.keys() & entries.keys():
        if isinstance(entries[name], str):
            texts[name] = entries[name][:MAX_ENTRY_CHARACTERS]
        else:
            problems.append(f"{name} {_short(entries[name])} is not text")
    return problems
