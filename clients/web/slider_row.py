"""A slider with its name, and its value in words."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import ui

from clients.web.numbers import NumberField

THROTTLE_S = 0.03
"""Between two values that are told while a slider is dragged."""


class SliderRow:
    """A slider of one number.

    Parameters
    ----------
    on_move : called with each value
    words : how a value is told; the number with its unit if not given
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
        """Show a value that came from elsewhere."""
        self._slider.value = value
        self._told.text = self._words(value)

    def enable(self, is_on: bool, why_not: str = "") -> None:
        """Let it be moved, or say why it cannot be."""
        self._slider.set_enabled(is_on)
        self._told.text = self._words(self._slider.value) if is_on else why_not
        self.row.classes(
            remove="oc-off" if is_on else "", add="" if is_on else "oc-off"
        )
