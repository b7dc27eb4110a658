"""The entries of one eye on the page."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterable
from functools import partial
from typing import Any

from nicegui import events, ui

from clients.web.comparison import CORRECTION_PREFIX, EyeName
from clients.web.controls import (
    AXIS,
    CYLINDER,
    PRESCRIPTION,
    RESIDUAL,
    SPHERE,
    SPHERE_SLIDER,
    STRAYLIGHT,
    NumberField,
    begins_prescription,
    prescription_texts,
)
from clients.web.correction_hints import (
    HELP,
    HELP_SUBJECTS,
    additions_text,
    correction_hint,
)
from clients.web.eye_form import (
    CATARACT,
    DESIGNS,
    DISTANCE_KINDS,
    HAZES,
    SIDES,
    YELLOWINGS,
    EyeForm,
    Haze,
    preset_titles,
)
from clients.web.widgets import (
    SliderRow,
    help_button,
    more,
    select,
    small_button,
    switch,
    title,
    toggle,
    upload_entry,
)
from estimator import MAX_PROFILE_BYTES, PROFILE_SUFFIXES

SOURCES = {"prescription": "Prescription", "preset": "Preset", "file": "File"}

NO_HIGHER_ORDER = (
    "Without aberrations of the age: the prescription is that after lens surgery."
)

RESIDUAL_PREFIX = "Residual "
"""Start of labels that the heading of their group says."""

MAX_HALF_CHARACTERS = 12
"""Length of the longest choice that half of the panel's width shows whole."""

BEFORE_SURGERY = "Before surgery:"
REMAINS = "Remains after surgery, through a 4 mm pupil:"

CATARACT_AGE_YEARS = 50.0
YOUNG_CATARACT = (
    "At {:.0f} years the eye still accommodates. Most people with a cataract are over "
    "60: set the age above."
)

TYPING_MS = 400
"""Pause after which a typed number is used; an incomplete one would be another eye."""

FOCUS = """setTimeout(() => {
  const box = document.querySelector("[data-eye-panel=%s] [data-choice='%s']");
  if (!box || document.activeElement !== document.body) return;
  const pressed = box.querySelector("[aria-pressed=true]");
  const part = pressed ?? (box.matches("input, [tabindex]") ? box
    : box.querySelector("input, [tabindex]"));
  part?.focus({preventScroll: true});
}, 100)"""
"""Gives the keyboard focus to a choice that replaced the one that had it."""

ChangeHandler = Callable[[events.ValueChangeEventArguments], None]


class EyePanel:
    """Entries of one eye or of one of its states, which update its form.

    Parameters
    ----------
    name : of the eye or state
    on_change : called when the entries have changed and are valid
    age_years : returns the age of the person
    set_age : called with the age that a preset comes with
    on_file : called with the eye, and the name and content of an uploaded profile file
    """

    def __init__(
        self,
        name: EyeName,
        form: EyeForm,
        on_change: Callable[[], None],
        age_years: Callable[[], float],
        set_age: Callable[[float], None],
        on_file: Callable[[EyeName, str, bytes], Awaitable[None]],
    ) -> None:
        self.name, self.form = name, form
        self._on_change, self._on_file = on_change, on_file
        self._age_years, self._set_age = age_years, set_age
        self._entries: dict[tuple[str, bool], ui.input] = {}
        self._choices: dict[str, ui.element] = {}  # by profile field
        self._marked: Collection[str] = ()
        self._additions: ui.label | None = None
        with ui.element("div").classes("oc-eye-box") as self.box:
            self.heading = title(SIDES[form.side], "h3", "oc-eye-title")
            with ui.element("div").classes("oc-eye") as entries:
                entries.props["data-eye-panel"] = name
                self.build()

    @ui.refreshable_method
    def build(self) -> None:
        """Show the entries of the form."""
        form = self.form
        self._entries.clear()
        self._choices.clear()
        self._choices["kind"] = toggle(
            SOURCES,
            form.source,
            self._takes(partial(setattr, form, "source")),
            label="Kind of entries",
            props="spread",
        )
        if form.source == "prescription":
            self._prescription()
        elif form.source == "preset":
            preset = select(
                preset_titles(),
                form.preset,
                self._takes(self._choose_preset),
                label="Preset",
            )
            self._choices["name"] = preset.classes("oc-wide").mark("preset")
        else:
            self._file()
        if form.loaded_name and form.source != "file":
            ui.label(f"Loaded: {form.loaded_name}").classes("oc-hint")
        self._media()
        ui.separator()
        self._correction()
        for field, choice in self._choices.items():
            choice.props["data-choice"] = field
        self.mark(self._marked)

    def mark(self, paths: Collection[str]) -> None:
        """Mark the entries of some profile fields: those that differ from A to B."""
        self._marked = paths
        if "correction" in paths:
            paths = {*paths, "correction.kind", "correction.design"}
        elements = {
            f"{CORRECTION_PREFIX if is_worn else ''}{field}": entry
            for (field, is_worn), entry in self._entries.items()
        }
        for path, element in (elements | self._choices).items():
            element.classes(**{"add" if path in paths else "remove": "oc-differs"})

    def _prescription(self) -> None:
        form = self.form
        if form.is_before_surgery:
            ui.label(BEFORE_SURGERY).classes("oc-hint oc-before-surgery")
        with ui.element("div").classes("oc-fields"):
            sphere = self._entry(SPHERE, form.texts)
            # linked with the entry in both directions
            slider = SliderRow(
                SPHERE_SLIDER,
                _position(sphere.value),
                lambda _, value: sphere.set_value(SPHERE.show(value)),
                is_titled=False,
            ).classes("oc-sphere")
            sphere.on_value_change(lambda event: slider.show(_position(event.value)))
            for number in PRESCRIPTION[1:]:
                self._entry(number, form.texts)
        if form.applies_higher_order:
            with more(is_open=not form.has_higher_order):
                self._choices["higher_order"] = self._switch(
                    "Higher-order aberrations of this age",
                    "has_higher_order",
                    rebuilds=False,
                )
        else:
            ui.label(NO_HIGHER_ORDER).classes("oc-hint")

    def _entry(
        self, number: NumberField, texts: dict[str, str], *, is_worn: bool = False
    ) -> ui.input:
        """Return an entry for one number, with validation."""
        is_pasted = is_left = False

        def problem(text: str | None) -> str | None:
            """Return the error in a text; none while a prescription is typed."""
            found = number.problem(text or "")
            is_typing = number is SPHERE and not is_left
            return None if is_typing and begins_prescription(text or "") else found

        def store(event: events.ValueChangeEventArguments) -> None:
            nonlocal is_pasted, is_left
            is_left = False
            texts[number.name] = event.value or ""
            if is_pasted and number is SPHERE and prescription_texts(event.value or ""):
                # nicegui sends no value for an entry while it handles the entry's event
                asyncio.get_running_loop().call_soon(normalize)
            elif problem(event.value) == number.problem(event.value or ""):
                self._on_change()  # an invalid entry is reported
            is_pasted = False

        def normalize() -> None:
            """Show the text as usual; a whole prescription fills its three entries."""
            nonlocal is_left
            text = entry.value or ""
            found = prescription_texts(text) if number is SPHERE else None
            if found is None:
                entry.set_value(number.normalized(text))
                if not is_left and number.problem(text):
                    is_left = True
                    entry.validate()
                    self._on_change()
                return
            for each, part in zip((SPHERE, CYLINDER, AXIS), found, strict=True):
                self._entries[each.name, is_worn].set_value(each.normalized(part))

        def paste() -> None:
            nonlocal is_pasted
            is_pasted = True

        entry = ui.input(
            number.label.removeprefix(RESIDUAL_PREFIX).capitalize(),
            value=texts[number.name],
            validation=problem,
            on_change=store,
        )
        entry.props(
            f'outlined dense suffix="{number.unit}" inputmode="text" '
            f'autocomplete="off" debounce={TYPING_MS}'
        ).classes("oc-entry")
        entry.props["data-name"] = number.name
        self._entries[number.name, is_worn] = entry
        entry.on("blur", normalize)
        entry.on("keyup.enter", normalize)  # after the browser's own change event
        entry.on("paste", paste)
        for key, steps in (("up", 1), ("down", -1)):
            entry.on(
                f"keydown.{key}.prevent",
                lambda _, steps=steps: entry.set_value(
                    number.normalized(entry.value or "", steps)
                ),
            )
        return entry

    def _file(self) -> None:
        form, suffixes = self.form, ", ".join(PROFILE_SUFFIXES)
        upload_entry(
            *("Profile", ",".join(PROFILE_SUFFIXES), MAX_PROFILE_BYTES),
            lambda name, content: self._on_file(self.name, name, content),
        ).classes("oc-wide").mark("profile-file")
        text = f"In use: {form.file_name}" if form.file_name else ""
        ui.label(text or f"A profile: {suffixes}").classes("oc-hint")

    def _media(self) -> None:
        """Show the entries of straylight and yellowing."""
        form = self.form
        with ui.element("div").classes("oc-fields"):
            for options, name, label, field, take in (
                (HAZES, "haze", "Straylight", "straylight", self._choose_haze),
                (
                    *(YELLOWINGS, "yellowing", "Yellowing", "yellowing"),
                    partial(setattr, form, "yellowing"),
                ),
            ):
                entry = select(
                    options,
                    getattr(form, name),
                    self._takes(take),
                    label=label,
                )
                is_long = len(options[getattr(form, name)]) > MAX_HALF_CHARACTERS
                width = "oc-whole" if is_long else "oc-half"
                self._choices[field] = entry.classes(width).mark(name)
            if form.haze == "measured":
                self._entry(STRAYLIGHT, form.media_texts)
        self._haze = ui.label("").classes("oc-hint oc-haze")
        self.show_haze()

    def show_haze(self) -> None:
        """Say how much light the eye scatters, which depends on the age."""
        age_years = self._age_years()
        texts = [self.form.haze_text(age_years=age_years)]
        is_cataract = self.form.source == "preset" and self.form.preset == CATARACT
        if is_cataract and age_years < CATARACT_AGE_YEARS:
            texts.append(YOUNG_CATARACT.format(age_years))
        self._haze.text = " ".join(filter(None, texts))
        self._haze.set_visibility(bool(self._haze.text))

    def _correction(self) -> None:
        form, worn = self.form, self.form.worn
        with ui.element("div").classes("oc-line"):
            self._choices["correction"] = self._switch(
                "Wears a correction", "wears_correction"
            )
            can_correct = not form.wears_correction or worn.kind in DISTANCE_KINDS
            if form.source == "prescription" and can_correct:
                with small_button("Correct fully", self._correct_fully):
                    ui.tooltip(
                        "Wear the prescription above; keep kind of lens and addition"
                    ).props('anchor="top middle" self="bottom middle"')
        if not form.wears_correction:
            return
        with ui.element("div").classes("oc-line"):
            self._choices["correction.kind"] = select(
                worn.kinds, worn.kind, self._takes(form.choose_worn), label="Correction"
            ).classes("oc-grow oc-worn-kind")
            if worn.kind in HELP:
                help_button(HELP_SUBJECTS[worn.kind], HELP[worn.kind])
        if worn.kind == "iol":
            self._choices["correction.design"] = select(
                DESIGNS,
                worn.design,
                self._takes(partial(setattr, worn, "design")),
                label="Design",
            ).classes("oc-wide oc-worn-design")
        ui.label(correction_hint(form)).classes("oc-note oc-hint")
        residual = [number for number in worn.entries if number in RESIDUAL]
        self._worn_entries([n for n in worn.entries if n not in RESIDUAL])
        self._additions = ui.label("").classes("oc-hint oc-additions")
        if residual:
            with ui.element("div").props('role=group aria-label="Residual refraction"'):
                ui.label(REMAINS).classes("oc-hint")
                self._worn_entries(residual, kind="oc-three")
        self.show_additions()

    def _worn_entries(self, numbers: Iterable[NumberField], kind: str = "") -> None:
        with ui.element("div").classes(f"oc-fields oc-worn {kind}"):
            for number in numbers:
                entry = self._entry(number, self.form.worn.texts, is_worn=True)
                entry.props["data-worn"] = ""

    def show_additions(self) -> None:
        """Say what the additions of an implant would be in spectacles."""
        if self._additions is not None and self.form.wears_correction:
            text = additions_text(self.form, age_years=self._age_years())
            self._additions.text = text
            self._additions.set_visibility(bool(text))

    def _switch(self, label: str, name: str, *, rebuilds: bool = True) -> ui.switch:
        take = self._takes(partial(setattr, self.form, name), rebuilds=rebuilds)
        return switch(label, getattr(self.form, name), take)

    # Event handlers

    def _takes(
        self, take: Callable[[Any], None], *, rebuilds: bool = True
    ) -> ChangeHandler:
        """Return a handler that passes a new value to a function.

        Parameters
        ----------
        rebuilds : bool
            Whether other entries are visible with the new value.
        """

        def handle(event: events.ValueChangeEventArguments) -> None:
            choices = self._choices.items()
            name = next((n for n, choice in choices if choice is event.sender), "")
            take(event.value)
            self.changed() if rebuilds else self._on_change()
            if rebuilds and name in self._choices:
                self.box.client.run_javascript(FOCUS % (self.name, name))

        return handle

    def _choose_preset(self, name: str) -> None:
        age_years = self.form.choose_preset(name, age_years=self._age_years())
        if age_years != self._age_years():
            self._set_age(age_years)

    def _choose_haze(self, haze: Haze) -> None:
        self.form.choose_haze(haze, age_years=self._age_years())

    def _correct_fully(self) -> None:
        self.form.correct_fully()
        self.changed()

    def changed(self) -> None:
        """Rebuild the panel after a change of the visible entries."""
        self.build.refresh()
        self._on_change()


def _position(text: str | None) -> float:
    """Return the position of the sphere's slider for a text."""
    try:
        return SPHERE_SLIDER.clamped(SPHERE.read(text or ""))
    except ValueError:
        return 0.0
