"""A slider with a label and a formatted value."""

from __future__ import annotations

from collections.abc import Callable

from nicegui.element import Element

from clients.web.numbers import NumberField

MAX_REPORTS = 2**53
"""Largest report number that a browser represents exactly."""


# nicegui, which takes the name of the component, has no types here
class SliderRow(Element, component="range_slider.js"):  # type: ignore[call-arg]
    """A slider for one number, as a native range input.

    Parameters
    ----------
    number : its name, label, range and step
    value : initial value
    on_move : called with each value
    format_value : formats a value; by default the number with its unit
    is_titled : whether label and value are visible; always available to assistive
        technology
    """

    def __init__(
        self,
        number: NumberField,
        value: float,
        on_move: Callable[[float], None],
        *,
        format_value: Callable[[float], str] | None = None,
        is_titled: bool = True,
    ) -> None:
        super().__init__()
        self.number = number
        self._format_value = format_value or (
            lambda v: number.with_unit(number.show(v))
        )
        self._on_move = on_move
        self._is_titled = is_titled
        self._disabled_text: str | None = None
        self._props.update(
            {
                "name": number.name,
                "label": number.label,
                "min": number.low,
                "max": number.high,
                "step": number.step,
                "answered": 0,
                "disabled": False,
            }
        )
        self.show(value)
        self.on("move", lambda event: self._moved(event.args))

    def _moved(self, sent: object) -> None:
        if not isinstance(sent, list) or len(sent) != 2:
            return
        value, report_number = self.number.within(sent[0]), sent[1]
        if value is not None and type(report_number) is int:
            self._props["answered"] = min(report_number, MAX_REPORTS)
            self.show(value)
            self._on_move(value)

    def show(self, value: float) -> None:
        """Show a value."""
        self._value = value
        self._props["value"] = value
        text = (
            self._format_value(value)
            if self._disabled_text is None
            else self._disabled_text
        )
        self._props["text"] = text if self._is_titled else ""
        self.update()

    def enable(self, is_on: bool, disabled_text: str = "") -> None:
        """Enable the slider, or disable it and show a text in place of the value."""
        self._props["disabled"] = not is_on
        self._disabled_text = None if is_on else disabled_text
        self.show(self._value)
