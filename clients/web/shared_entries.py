"""The entries of a page as text, for reloads and for links.

The text is the fragment of the page's address, which browsers do not send.  It contains
the entries that differ from a new page, and never the content of a file.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass, field
from typing import Any, get_args

from clients.web.correction_form import DESIGNS, KINDS, CorrectionForm
from clients.web.eye_form import SIDES, EyeForm, preset_titles
from clients.web.page_state import CONDITIONS, PageState, Shown

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
    if entries.get("shown") in get_args(Shown):
        state.shown = entries["shown"]
    scene = entries.get("scene")
    found.scene = scene if scene in SCENES else SCENES[0]
    values = _mapping(entries.get("values"))
    for number in CONDITIONS:
        if number.name not in values:
            continue
        value = values[number.name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            found.problems.append(f"{number.label}: {value!r:.30} is not a number.")
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
        entries = json.loads(base64.urlsafe_b64decode(padded))
    except (ValueError, binascii.Error, RecursionError):
        return None
    if not isinstance(entries, dict) or entries.get("v") != VERSION:
        return None
    return entries


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _restore_eye(form: EyeForm, entries: dict[str, Any]) -> list[str]:
    problems = []
    if entries.get("source") == "file":
        name = str(entries.get("file", ""))[:MAX_ENTRY_CHARACTERS]
        if form.file_body is not None and form.file_name[:MAX_ENTRY_CHARACTERS] == name:
            form.source = "file"
        else:
            problems.append(
                f"the profile file {name!r} is not part of a link; upload it"
            )
    elif entries.get("source") == "preset":
        form.source = "preset"
    if entries.get("preset") in preset_titles():
        form.preset = entries["preset"]
    elif "preset" in entries:
        problems.append(f"preset {entries['preset']!r:.30} is unknown")
    form.has_higher_order = entries.get("higher_order") is not False
    _restore_texts(form.texts, _mapping(entries.get("texts")))
    correction = _mapping(entries.get("correction"))
    if correction:
        form.wears_correction = True
        form.worn = CorrectionForm()
        if correction.get("kind") in KINDS:
            form.worn.kind = correction["kind"]
        else:
            problems.append(f"correction {correction.get('kind')!r:.30} is unknown")
        if correction.get("design") in DESIGNS:
            form.worn.design = correction["design"]
        _restore_texts(form.worn.texts, _mapping(correction.get("texts")))
    return problems


def _restore_texts(texts: dict[str, str], entries: dict[str, Any]) -> None:
    """Set known entries; the form reports invalid ones, as it does typed ones."""
    for name in texts:
        if name in entries:
            texts[name] = str(entries[name])[:MAX_ENTRY_CHARACTERS]
