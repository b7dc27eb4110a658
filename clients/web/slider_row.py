"""A slider with its name and its formatted value."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import ui

from clients.web.numbers import NumberField

THROTTLE_S = 0.03
"""Least time between two values reported while a slider is dragged."""


class SliderRow:
    """A slider for one number.

    Parameters
    ----------
    on_move : called with each value
    words : formats a value; by default the number with its unit
    """

    def __init__(
        self,
        number: NumberField,
        value: float,
        on_move: Callable[[float], None],
        *,
        words: Callable[[float], str] | None = None,
    ) -> None:
        self.number = number
        self._words = words or (lambda v: number.with_unit(number.show(v)))
        self._on_move = on_move
        with ui.element("div").classes("oc-slider") as self.row:
            with ui.element("div").classes("oc-slider-head"):
                ui.label(number.label)
                self._told = ui.label(self._words(value)).classes("oc-value")
            self._slider = (
                ui.slider(
                    min=number.low, max=number.high, step=number.step, value=value
                )
                .props(f'aria-label="{number.label}" dense')
                .mark(number.name)
            )
            self._slider.props["data-name"] = number.name
            self._slider.on(
                "update:model-value",
                lambda event: self._moved(event.args),
                throttle=THROTTLE_S,
            )

    def _moved(self, sent: object) -> None:
        value = self.number.within(sent)
        if value is not None:
            self._told.text = self._words(value)
            self._on_move(value)

    def show(self, value: float) -> None:
        """Show a value that was set elsewhere."""
        self._slider.value = value
        self._told.text = self._words(value)

    def enable(self, is_on: bool, why_not: str = "") -> None:
        """Enable the slider, or disable it and show why."""
        self._slider.set_enabled(is_on)
        self._told.text = self._words(self._slider.value) if is_on else why_not
        self.row.classes(
            remove="oc-off" if is_on else "", add="" if is_on else "oc-off"
        )
