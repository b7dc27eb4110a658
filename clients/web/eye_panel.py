"""The entries of one eye on the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from nicegui import events, ui

from clients.web.correction_form import DESIGNS, HINTS, PRESCRIPTION, SPHERE
from clients.web.eye_form import (
    MAX_PROFILE_BYTES,
    PROFILE_SUFFIXES,
    EyeForm,
    preset_titles,
)
from clients.web.numbers import NumberField
from clients.web.slider_row import SliderRow
from clients.web.upload_entry import upload_entry

SOURCES = {"prescription": "Prescription", "preset": "Preset", "file": "File"}
SLIDER_REACH_DPT = 10.0
"""Range of the slider beside the sphere; typed values may go further."""

SPHERE_SLIDER = replace(
    SPHERE, name="sphere_slider_dpt", low=-SLIDER_REACH_DPT, high=SLIDER_REACH_DPT
)

TYPING_MS = 400
"""Pause after which a typed number counts: half of one is another eye."""


class EyePanel:
    """Entries of one eye, which keep its form up to date.

    Parameters
    ----------
    on_change : called when the entries have changed and are valid
    on_age : called with the age that a file states, years
    """

    def __init__(
        self,
        form: EyeForm,
        on_change: Callable[[], None],
        on_age: Callable[[float], None],
    ) -> None:
        self.form = form
        self._on_change, self._on_age = on_change, on_age
        with ui.element("div").classes("oc-eye") as self.box:
            self.box.props["data-eye-panel"] = form.side
            self._build()

    @ui.refreshable_method
    def _build(self) -> None:
        form = self.form
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

    def _entry(self, number: NumberField, texts: dict[str, str]) -> ui.input:
        """Return an entry for one number, with validation."""

        def take(event: events.ValueChangeEventArguments) -> None:
            texts[number.name] = event.value or ""
            self._on_change()  # an invalid entry is reported

        entry = ui.input(
            number.label,
            value=texts[number.name],
            validation=lambda text: number.problem(text or ""),
            on_change=take,
        )
        entry.props(
            f'outlined dense suffix="{number.unit}" inputmode="text" '
            f'autocomplete="off" debounce={TYPING_MS}'
        ).classes("oc-entry")
        entry.props["data-name"] = number.name
        entry.on("blur", lambda: entry.set_value(number.normalized(entry.value or "")))
        for key, steps in (("up", 1), ("down", -1)):
            entry.on(
                f"keydown.{key}.prevent",
                lambda _, steps=steps: entry.set_value(
                    number.stepped(entry.value or "", steps)
                ),
            )
        return entry

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
            if form.source == "prescription":
                ui.button("Correct fully", on_click=self._correct_fully).props(
                    "flat dense no-caps size=sm"
                ).tooltip("Wear spectacles of the prescription above")
        if form.wears_correction:
            self._correction_entries()

    def _correction_entries(self) -> None:
        correction = self.form.correction
        ui.select(
            correction.kinds,
            value=correction.kind,
            on_change=self._choose_correction,
            label="Correction",
        ).props("outlined dense options-dense").classes("oc-wide oc-worn-kind")
        if correction.kind == "iol":
            ui.select(
                DESIGNS,
                value=correction.design,
                on_change=self._choose_design,
                label="Design",
            ).props("outlined dense options-dense").classes("oc-wide oc-worn-design")
        with ui.element("div").classes("oc-fields oc-worn"):
            for number in correction.entries:
                self._entry(number, correction.texts).props["data-worn"] = ""
        if correction.kind in HINTS:
            ui.label(HINTS[correction.kind]).classes("oc-hint")

    def copy(self, other: EyeForm) -> None:
        """Copy the entries of the other eye."""
        form = self.form
        form.source, form.preset = other.source, other.preset
        form.texts, form.correction = dict(other.texts), other.correction.copy()
        form.has_higher_order = other.has_higher_order
        form.file_body, form.file_name = other.file_body, other.file_name
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

    def _choose_correction(self, event: events.ValueChangeEventArguments) -> None:
        self.form.correction.kind = event.value
        self._changed()

    def _choose_design(self, event: events.ValueChangeEventArguments) -> None:
        self.form.correction.design = event.value
        self._changed()

    def _correct_fully(self) -> None:
        self.form.correct_fully()
        self._changed()

    async def _take_file(self, name: str, content: bytes) -> None:
        age_years = self.form.take_file(name, content)
        if age_years is not None:
            self._on_age(age_years)
        self._changed()

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
