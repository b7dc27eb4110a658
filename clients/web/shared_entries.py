"""The entries of a page as text, for reloads and for links.

The text is the fragment of the page's address, which browsers do not send.  It contains
the entries that differ from a new page, and never the content of a file.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

from clients.web.correction_form import DESIGNS, KINDS, CorrectionForm
from clients.web.eye_form import SIDES, EyeForm, Source, preset_titles
from clients.web.page_state import CONDITIONS, PageState, Shown
from estimator.bounded_files import loads_bounded
from filter_service.settings import Pipeline

VERSION = 1
MAX_CHARACTERS = 8000
"""Length limit of a fragment; every entry of both eyes takes 1,600 characters."""

MAX_ENTRY_CHARACTERS = 40
SCENES = ("courtyard", "primitives", "chart")
"""Scenes that need no file."""


@dataclass
class Restored:
    """Result of reading a link.

    Attributes
    ----------
    scene : str or None
        Scene to show; None if the fragment contains no entries for a page.
    problems : list of str
        Sentences about rejected entries of the link.
    """

    scene: str | None = None
    problems: list[str] = field(default_factory=list)


def fragment_of(state: PageState, scene: str) -> str:
    """Return the entries as the fragment of an address, without ``#``."""
    new = PageState()
    entries: dict[str, Any] = {"v": VERSION}
    if state.shown != new.shown:
        entries["shown"] = state.shown
    if state.pipeline != new.pipeline:
        entries["pipeline"] = state.pipeline
    if scene in SCENES[1:]:
        entries["scene"] = scene
    values = {name: v for name, v in state.values.items() if v != new.values[name]}
    if state.is_focus_set:
        entries["focus_set"] = True
    if values:
        entries["values"] = {name: round(v, 4) for name, v in values.items()}
    eyes = {side: _eye(form, new.eyes[side]) for side, form in state.eyes.items()}
    eyes = {side: found for side, found in eyes.items() if found}
    if eyes:
        entries["eyes"] = eyes
    text = json.dumps(entries, separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _eye(form: EyeForm, new: EyeForm) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if form.source != new.source:
        found["source"] = form.source
    if form.source == "file":
        found["file"] = form.file_name[:MAX_ENTRY_CHARACTERS]
    if form.preset != new.preset:
        found["preset"] = form.preset
    if form.has_higher_order != new.has_higher_order:
        found["higher_order"] = form.has_higher_order
    texts = {name: t for name, t in form.texts.items() if t != new.texts[name]}
    if texts:
        found["texts"] = texts
    if form.wears_correction:
        found["correction"] = {
            "kind": form.worn.kind,
            "design": form.worn.design,
            "texts": form.worn.texts,
        }
    return found


def restore(state: PageState, fragment: str) -> Restored:
    """Set a page's entries from a fragment; report rejected entries.

    Entries are validated like typed ones.  Invalid and missing ones get their initial
    values.
    """
    found = Restored()
    entries = _read(fragment)
    if entries is None:
        found.problems.append(
            "The link contains no entries for this page; it may be incomplete."
        )
        return found
    state.reset()
    state.is_focus_set = entries.get("focus_set") is True
    state.shown = _choice(entries, "shown", get_args(Shown)) or state.shown
    state.pipeline = _choice(entries, "pipeline", get_args(Pipeline)) or state.pipeline
    found.scene = _choice(entries, "scene", SCENES) or SCENES[0]
    values = _mapping(entries.get("values"))
    for number in CONDITIONS:
        if number.name not in values:
            continue
        value = values[number.name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            found.problems.append(f"{number.label}: {_short(value)} is not a number.")
            continue
        problem = number.problem(f"{value:g}")
        if problem:
            found.problems.append(f"{number.label}: {problem}.")
        else:
            state.values[number.name] = float(value)
    eyes = _mapping(entries.get("eyes"))
    for side, title in SIDES.items():
        problems = _restore_eye(state.eyes[side], _mapping(eyes.get(side)))
        found.problems += [f"{title}: {problem}." for problem in problems]
    return found


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


def _mapping(value: object) -> dict[str, Any]:
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
        if form.file_body is not None and form.file_name[:MAX_ENTRY_CHARACTERS] == name:
            form.source = "file"
        else:
            problems.append(
                f"the profile file {name!r} is not part of a link; upload it"
            )
    elif source is not None:
        form.source = source
    if preset := _choice(entries, "preset", preset_titles()):
        form.preset = preset
    elif "preset" in entries:
        problems.append(f"preset {_short(entries['preset'])} is unknown")
    form.has_higher_order = entries.get("higher_order") is not False
    problems += _restore_texts(form.texts, _mapping(entries.get("texts")))
    correction = _mapping(entries.get("correction"))
    if correction:
        form.wears_correction = True
        form.worn = CorrectionForm()
        if kind := _choice(correction, "kind", KINDS):
            form.worn.kind = kind
        else:
            problems.append(f"correction {_short(correction.get('kind'))} is unknown")
        form.worn.design = _choice(correction, "design", DESIGNS) or form.worn.design
        problems += _restore_texts(form.worn.texts, _mapping(correction.get("texts")))
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
