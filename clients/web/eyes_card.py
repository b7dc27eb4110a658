"""The eyes on the page: which are shown, states A and B, their entries, differences."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial

from nicegui import events, ui

from clients.web.comparison import EyeName
from clients.web.controls import AGE, NumberField
from clients.web.eye_form import SIDES
from clients.web.eye_panel import EyePanel
from clients.web.page_state import PageState
from clients.web.widgets import (
    SliderRow,
    card,
    help_button,
    problem_label,
    small_button,
    switch,
    title,
    toggle,
)

SHOWN = {"OD": "Right eye", "OS": "Left eye", "both": "Both"}
EDITED = {"A": "A", "B": "B"}

COMPARED = (
    "A and B are two states of this eye. What differs is marked in orange; “B = A” "
    "copies all entries of A."
)
EYE_HELP = (
    "Describe the eye by its prescription, a preset or a file. A normal eye of 30 "
    "years is not perfect: it blurs toward the side and has slight aberrations and "
    "colored fringes, which the picture shows and which its owner does not notice. "
    "The age limits accommodation to the amplitude that instruments measure; a push-up "
    "measurement includes the depth of focus and is higher. "
    "“Compare” adds a second state of the same eye, B, which starts as a copy of A: "
    "change what differs, such as the correction or the age. Differences are marked."
)


class EyesCard:
    """Which eyes are shown, their states A and B, and their entries.

    Parameters
    ----------
    add_slider : adds the slider of a number
    on_shown : called when other eyes or states are shown
    on_change : called when the entries have changed and are valid
    on_file : called with the eye, and the name and content of an uploaded profile file
    """

    def __init__(
        self,
        state: PageState,
        add_slider: Callable[[NumberField], SliderRow],
        *,
        on_shown: Callable[[], None],
        on_change: Callable[[], None],
        on_file: Callable[[EyeName, str, bytes], Awaitable[None]],
    ) -> None:
        self._state, self._on_shown = state, on_shown
        self._on_change, self._on_file = on_change, on_file
        with card("Eye", "oc-eyes"):
            with ui.element("div").classes("oc-line"):
                title("The eye")
                help_button("the eye", EYE_HELP)
                ui.element("span").classes("oc-grow")
                self._copy = ui.button("Copy to the other eye", on_click=self._copy_eye)
                self._copy.props("flat dense no-caps size=sm")
            self._shown = toggle(
                *(SHOWN, state.shown, self._show),
                label="Eyes shown",
                props="spread",
                kind="oc-shown",
            )
            with ui.element("div").classes("oc-line oc-compare"):
                self._compare = switch(
                    "Compare A | B", state.is_comparing, self._set_comparing
                )
                self._tools = ui.element("div").classes("oc-downloads")
                with self._tools:
                    for label, act, tip in (
                        ("Swap", state.swap, "Exchange A and B"),
                        ("B = A", state.copy_to_b, "Copy the entries of A to B"),
                    ):
                        small_button(label, partial(self._edit, act)).tooltip(tip)
            self._edited = toggle(
                *(EDITED, "A", lambda _: self._show_boxes()),
                label="State to edit",
                props="spread",
                kind="oc-edited",
            )
            self._explained = ui.label(COMPARED).classes("oc-hint oc-compared")
            self._add_slider = add_slider
            self._ages = {AGE: add_slider(AGE)}
            self._age_b = ui.element("div")
            self._box = ui.element("div")
            self._panels: dict[EyeName, EyePanel] = {}
            for name in SIDES:
                self._add_panel(name)
            self.problem = problem_label()
            self._show_boxes()

    def build_differences(self) -> None:
        """Build the list of the entries that differ."""
        self._difference = ui.label("").classes("oc-note oc-difference")
        self._difference.props("aria-live=polite")

    def _add_panel(self, name: EyeName) -> None:
        """Add the entries of an eye or state, unless they are there."""
        number = self._state.age(name)
        if number not in self._ages:
            with self._age_b:
                self._ages[number] = self._add_slider(number)
        if name not in self._panels:
            with self._box:
                form = self._state.form(name)
                self._panels[name] = EyePanel(
                    *(name, form, self._on_change),
                    age_years=lambda: self._state.values[number.name],
                    set_age=self._ages[number].move,
                    on_file=self._on_file,
                )

    def show_eye(self, name: EyeName) -> None:
        """Show an eye, like a click on its button."""
        self._shown.value = name

    def refresh(self) -> None:
        """Show all entries after changes that were not made in the panels."""
        self._shown.value = self._state.shown
        self._compare.value = self._state.is_comparing
        for panel in self._panels.values():
            panel.build.refresh()
        self._show_boxes()

    def _show(self, event: events.ValueChangeEventArguments) -> None:
        if event.value == self._state.shown:
            return
        self._state.shown = event.value
        is_one = event.value != "both"
        self._state.compare(is_one and self._state.wants_comparison)
        self._show_boxes()
        self._on_shown()

    def _set_comparing(self, event: events.ValueChangeEventArguments) -> None:
        if event.value == self._state.is_comparing:
            return
        self._state.compare(event.value)
        if event.value:
            self._edited.value = "B"  # A is what was there
        self.refresh()
        self._on_shown()

    def _edit(self, act: Callable[[], None]) -> None:
        act()
        self.refresh()
        self._on_shown()

    def _show_boxes(self) -> None:
        """Show the entries of the eyes that are shown, or of the state to edit."""
        state, edited = self._state, self._state.names
        self._compare.value = state.is_comparing
        if state.is_comparing:
            self._add_panel(edited[1])
            edited = (edited[list(EDITED).index(str(self._edited.value))],)
        for name, panel in self._panels.items():
            panel.box.set_visibility(name in edited)
            panel.heading.set_visibility(state.shown == "both")
        for element in (self._tools, self._edited, self._explained):
            element.set_visibility(state.is_comparing)
        for number, row in self._ages.items():
            row.set_visibility(state.age(edited[0]) is number)
        self._copy.set_visibility(state.shown != "both" and not state.is_comparing)

    def _copy_eye(self) -> None:
        side = self._state.sides[0]
        other = next(s for s in SIDES if s != side)
        self._state.eyes[other].copy(self._state.eyes[side])
        self._panels[other].changed()
        ui.notify(
            f"{SIDES[other]}: as the {SIDES[side].lower()}",
            position="top",
            timeout=2000,
        )

    def show_differences(self) -> None:
        """Mark the entries that differ from A to B, and list them."""
        found = self._state.differences()
        paths = {one.path for one in found}
        for name, panel in self._panels.items():
            panel.show_haze()
            panel.show_additions()
            panel.mark(paths if name in self._state.names else ())
        listed = "; ".join(f"{one.label}: {one.a} → {one.b}" for one in found)
        if not self._state.is_comparing:
            self._difference.text = ""
        elif found:
            self._difference.text = f"From A to B: {listed}."
        else:
            self._difference.text = "A and B are the same: change one of them."
