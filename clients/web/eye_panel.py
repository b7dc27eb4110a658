"""The entries of one eye on the page."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

from nicegui import events, ui

from clients.web.correction_form import (
    AXIS,
    CYLINDER,
    DESIGNS,
    DISTANCE_KINDS,
    HINTS,
    PRESCRIPTION,
    SPHERE,
)
from clients.web.eye_form import (
    EyeForm,
    EyeSide,
    preset_titles,
)
from clients.web.numbers import NumberField, prescription_texts
from clients.web.slider_row import SliderRow
from clients.web.upload_entry import upload_entry
from estimator import MAX_PROFILE_BYTES, PROFILE_SUFFIXES

SOURCES = {"prescription": "Prescription", "preset": "Preset", "file": "File"}
SLIDER_REACH_DPT = 10.0
"""Range of the sphere slider; typed values may exceed it."""

SPHERE_SLIDER = replace(
    SPHERE, name="sphere_slider_dpt", low=-SLIDER_REACH_DPT, high=SLIDER_REACH_DPT
)

TYPING_MS = 400
"""Pause after which a typed number is used; an incomplete one would be another eye."""


class EyePanel:
    """Entries of one eye, which update its form.

    Parameters
    ----------
    on_change : called when the entries have changed and are valid
    on_file : called with the eye, and the name and content of an uploaded profile file
    """

    def __init__(
        self,
        form: EyeForm,
        on_change: Callable[[], None],
        on_file: Callable[[EyeSide, str, bytes], Awaitable[None]],
    ) -> None:
        self.form = form
        self._on_change, self._on_file = on_change, on_file
        self._entries: dict[tuple[str, bool], ui.input] = {}
        with ui.element("div").classes("oc-eye") as self.box:
            self.box.props["data-eye-panel"] = form.side
            self._build()

    @ui.refreshable_method
    def _build(self) -> None:
        form = self.form
        self._entries.clear()
        ui.toggle(SOURCES, value=form.source, on_change=self._choose_source).props(
            'no-caps unelevated spread dense role=group aria-label="Kind of entries"'
        ).classes("oc-toggle")
        if form.source == "prescription":
            self._prescription()
        elif form.source == "preset":
            ui.select(
                preset_titles(),
                value=form.preset,
                on_change=self._choose_preset,
                label="Preset",
            ).props("outlined dense options-dense").classes("oc-wide").mark("preset")
        else:
            self._file()
        if form.loaded_name and form.source != "file":
            ui.label(f"Loaded: {form.loaded_name}").classes("oc-hint")
        ui.separator()
        self._correction()

    def _prescription(self) -> None:
        form = self.form
        with ui.element("div").classes("oc-fields"):
            sphere = self._entry(SPHERE, form.texts)
            self._sphere_slider(sphere)
            for number in PRESCRIPTION[1:]:
                self._entry(number, form.texts)
        ui.switch(
            "Higher-order aberrations of this age",
            value=form.has_higher_order,
            on_change=self._switch_higher_order,
        ).props("dense").classes("oc-switch")

    def _sphere_slider(self, entry: ui.input) -> None:
        """Show a slider that is linked with an entry in both directions."""
        slider = SliderRow(
            SPHERE_SLIDER,
            _within(entry.value),
            lambda value: entry.set_value(SPHERE.show(value)),
            is_titled=False,
        ).classes("oc-sphere")
        entry.on_value_change(lambda event: slider.show(_within(event.value)))

    def _entry(
        self, number: NumberField, texts: dict[str, str], *, is_worn: bool = False
    ) -> ui.input:
        """Return an entry for one number, with validation."""
        is_pasted = False

        def store(event: events.ValueChangeEventArguments) -> None:
            nonlocal is_pasted
            texts[number.name] = event.value or ""
            if is_pasted and number is SPHERE and prescription_texts(event.value or ""):
                # nicegui sends no value for an entry while it handles the entry's event
                asyncio.get_running_loop().call_soon(normalize)
            else:
                self._on_change()  # an invalid entry is reported
            is_pasted = False

        def normalize() -> None:
            text = entry.value or ""
            if not self._split_prescription(number, text, is_worn):
                entry.set_value(number.normalized(text))

        def paste() -> None:
            nonlocal is_pasted
            is_pasted = True

        entry = ui.input(
            number.label,
            value=texts[number.name],
            validation=lambda text: number.problem(text or ""),
            on_change=store,
        )
        entry.props(
            f'outlined dense suffix="{number.unit}" inputmode="text" '
            f'autocomplete="off" debounce={TYPING_MS}'
        ).classes("oc-entry")
        entry.props["data-name"] = number.name
        self._entries[number.name, is_worn] = entry
        entry.on("blur", normalize)
        entry.on("paste", paste)
        for key, steps in (("up", 1), ("down", -1)):
            entry.on(
                f"keydown.{key}.prevent",
                lambda _, steps=steps: entry.set_value(
                    number.stepped(entry.value or "", steps)
                ),
            )
        return entry

    def _split_prescription(
        self, number: NumberField, text: str, is_worn: bool
    ) -> bool:
        """Set sphere, cylinder and axis from a whole prescription in the sphere."""
        found = prescription_texts(text) if number is SPHERE else None
        if found is None:
            return False
        for each, part in zip((SPHERE, CYLINDER, AXIS), found, strict=True):
            self._entries[each.name, is_worn].set_value(each.normalized(part))
        return True

    def _file(self) -> None:
        upload_entry(
            "Profile", ",".join(PROFILE_SUFFIXES), MAX_PROFILE_BYTES, self._take_file
        ).classes("oc-wide").mark("profile-file")
        text = (
            f"In use: {self.form.file_name}"
            if self.form.file_name
            else (f"A profile: {', '.join(PROFILE_SUFFIXES)}")
        )
        ui.label(text).classes("oc-hint")

    def _correction(self) -> None:
        form = self.form
        with ui.element("div").classes("oc-line"):
            ui.switch(
                "Wears a correction",
                value=form.wears_correction,
                on_change=self._switch_correction,
            ).props("dense").classes("oc-switch")
            can_correct = not form.wears_correction or form.worn.kind in DISTANCE_KINDS
            if form.source == "prescription" and can_correct:
                ui.button("Correct fully", on_click=self._correct_fully).props(
                    "flat dense no-caps size=sm"
                ).tooltip("Wear the prescription above; keep kind of lens and addition")
        if form.wears_correction:
            self._worn()

    def _worn(self) -> None:
        worn = self.form.worn
        ui.select(
            worn.kinds, value=worn.kind, on_change=self._choose_worn, label="Correction"
        ).props("outlined dense options-dense").classes("oc-wide oc-worn-kind")
        if worn.kind == "iol":
            ui.select(
                DESIGNS,
                value=worn.design,
                on_change=self._choose_design,
                label="Design",
            ).props("outlined dense options-dense").classes("oc-wide oc-worn-design")
        with ui.element("div").classes("oc-fields oc-worn"):
            for number in worn.entries:
                entry = self._entry(number, worn.texts, is_worn=True)
                entry.props["data-worn"] = ""
        if worn.kind in HINTS:
            ui.label(HINTS[worn.kind]).classes("oc-hint")

    def copy(self, other: EyeForm) -> None:
        """Copy the entries of the other eye."""
        form = self.form
        form.source, form.preset = other.source, other.preset
        form.texts, form.worn = dict(other.texts), other.worn.copied()
        form.has_higher_order = other.has_higher_order
        form.file_body, form.file_name = other.file_body, other.file_name
        form.loaded_name = other.loaded_name
        form.wears_correction = other.wears_correction
        self._changed()

    # Event handlers

    def _choose_source(self, event: events.ValueChangeEventArguments) -> None:
        self.form.source = event.value
        self._changed()

    def _choose_preset(self, event: events.ValueChangeEventArguments) -> None:
        self.form.preset = event.value
        self._on_change()

    def _switch_higher_order(self, event: events.ValueChangeEventArguments) -> None:
        self.form.has_higher_order = event.value
        self._on_change()

    def _switch_correction(self, event: events.ValueChangeEventArguments) -> None:
        self.form.wears_correction = event.value
        self._changed()

    def _choose_worn(self, event: events.ValueChangeEventArguments) -> None:
        self.form.choose_worn(event.value)
        self._changed()

    def _choose_design(self, event: events.ValueChangeEventArguments) -> None:
        self.form.worn.design = event.value
        self._changed()

    def _correct_fully(self) -> None:
        self.form.correct_fully()
        self._changed()

    async def _take_file(self, name: str, content: bytes) -> None:
        await self._on_file(self.form.side, name, content)

    def show(self) -> None:
        """Show the entries of the form again."""
        self._build.refresh()

    def _changed(self) -> None:
        """Rebuild the panel after a change of the visible entries."""
        self._build.refresh()
        self._on_change()


def _within(text: str | None) -> float:
    """Return the slider's position for a text."""
    try:
        value = SPHERE.read(text or "")
    except ValueError:
        return 0.0
    return min(max(value, -SLIDER_REACH_DPT), SLIDER_REACH_DPT)
