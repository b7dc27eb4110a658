"""The entries of a page as text, for links.

The text is the fragment of the page's address, which browsers do not send.  It contains
the entries that differ from a new page, and never the content of a file.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple, get_args

from clients.acuity_text import Notation
from clients.web.comparison import EYE_NAMES, title_of
from clients.web.controls import CONDITIONS, LIGHTS
from clients.web.eye_form import (
    DESIGNS,
    HAZES,
    KINDS,
    SIDES,
    YELLOWINGS,
    CorrectionForm,
    EyeForm,
    Source,
    implant_of_version_0_2,
    is_of_version_0_2,
    preset_titles,
)
from clients.web.page_state import SCENES, Arrangement, PageState, Shown
from estimator.bounded_files import loads_bounded
from filter_service.settings import Pipeline

VERSION = 1
MAX_CHARACTERS = 8000
"""Limit of a fragment; all entries of four states take 3,600 characters."""

MAX_ENTRY_CHARACTERS = 40


def fragment_of(state: PageState, scene: str) -> str:
    """Return the entries as the fragment of an address, without ``#``."""
    initial = _entries(PageState(wants_comparison=True), SCENES[0])
    changes = _changes(_entries(state, scene), initial | {"compared": False})
    text = json.dumps({"v": VERSION, **changes}, separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _entries(state: PageState, scene: str) -> dict[str, Any]:
    return {
        "shown": state.shown,
        "pipeline": state.pipeline,
        "scene": scene if scene in SCENES else SCENES[0],
        "focus_set": state.is_focus_set,
        "compared": state.wants_comparison,
        "arrangement": state.arrangement,
        "light": state.light,
        "notation": state.notation,
        "values": {name: round(value, 4) for name, value in state.values.items()},
        "eyes": {
            name: _eye_entries(state.form(name))
            for name in EYE_NAMES
            if state.wants_comparison or name in SIDES
        },
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

    They are validated like typed ones; invalid and missing ones get initial values.
    """
    entries = _read(fragment)
    if entries is None:
        text = "The link contains no entries for this page; it may be incomplete."
        return Restored(None, [text])
    state.reset()
    state.is_focus_set = entries.get("focus_set") is True
    state.wants_comparison = entries.get("compared") is True
    state.arrangement = (
        _choice(entries, "arrangement", get_args(Arrangement)) or state.arrangement
    )
    state.shown = _choice(entries, "shown", get_args(Shown)) or state.shown
    state.pipeline = _choice(entries, "pipeline", get_args(Pipeline)) or state.pipeline
    state.light = _choice(entries, "light", LIGHTS) or state.light
    state.notation = _choice(entries, "notation", get_args(Notation)) or state.notation
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
    for name in EYE_NAMES if state.wants_comparison else SIDES:
        title = title_of(name, is_comparing=state.is_comparing)
        found = _restore_eye(state.form(name), _mapping(eyes, name))
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
