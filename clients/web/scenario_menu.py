"""Menu of scenarios: one choice sets scene, conditions, and states A and B."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import events, ui

from clients.scenarios import scenarios
from clients.web.page_state import PageState
from clients.web.widgets import select

CHOOSE = "choose"


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
        self._text.text = (
            f"A: {scenario.a.title}. B: {scenario.b.title}. "
            f"{scenario.sees} {scenario.leaves_out}"
        )
        self._state.start_scenario(scenario)
        self._on_start(scenario.scene)

    def leave_unless(self, scene: str) -> None:
        """Forget the scenario if another scene was selected."""
        scenario = scenarios().get(self._list.value)
        if scenario is not None and scenario.scene != scene:
            self.clear()

    def clear(self) -> None:
        """Forget the scenario, for example when a link was followed."""
        self._list.value = CHOOSE
