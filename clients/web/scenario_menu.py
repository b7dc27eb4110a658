"""Menu of scenarios: one choice sets scene, conditions, and states A and B."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.scenarios import scenarios
from clients.web.controls import AGES, CONDITIONS
from clients.web.page_state import PageState
from clients.web.page_texts import scenario_text
from clients.web.widgets import select

CHOOSE = "choose"
CONDITION_TEXTS = [number for number in CONDITIONS if number not in AGES]


class ScenarioMenu:
    """A list of scenarios, and two sentences about the chosen one.

    Parameters
    ----------
    on_start : called with the scene of a scenario that was chosen
    """

    def __init__(self, state: PageState, on_start: Callable[[str], None]) -> None:
        self._state, self._on_start = state, on_start
        titles = {name: scenario.title for name, scenario in scenarios().items()}
        self._list = select(
            {CHOOSE: "Choose one", **titles}, CHOOSE, self._choose, label="Scenarios"
        ).classes("oc-scenarios")

    def build_text(self) -> None:
        """Build the sentences about the scenario."""
        self._text = ui.label("").classes("oc-hint oc-scenario-text")
        self._text.set_visibility(False)

    def _choose(self, event: events.ValueChangeEventArguments) -> None:
        scenario = scenarios().get(event.value)
        self._text.set_visibility(scenario is not None)
        if scenario is None:
            return
        self._state.start_scenario(scenario)
        self._initial = self._entries(scenario.scene)
        self.show_changes(scenario.scene)
        self._on_start(scenario.scene)

    def show_changes(self, scene: str) -> None:
        """Say what of the scenario has changed; forget it when its eyes are left."""
        scenario = scenarios().get(self._list.value)
        if scenario is None:
            return
        if set(self._state.names) != set(self._initial["names"]):
            self.clear()
            return
        entries = self._entries(scene)
        changed = [part for part, one in self._initial.items() if one != entries[part]]
        self._text.text = scenario_text(scenario, changed)

    def _entries(self, scene: str) -> dict[str, Any]:
        """Return the parts of a scenario that a person can change."""
        state = self._state
        state.read_profiles()
        shown = {one.name: one.show(state.values[one.name]) for one in CONDITION_TEXTS}
        profiles = {
            f"entries of {state.title(name)}": state.valid_profiles.get(name)
            for name in state.names
        }
        return {
            "names": state.names,
            "scene": scene,
            "viewing conditions": shown,
            **profiles,
        }

    def clear(self) -> None:
        """Forget the scenario, for example when a link was followed."""
        self._list.value = CHOOSE
