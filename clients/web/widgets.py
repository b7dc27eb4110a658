"""Elements of the page: titles, choices, sliders, file uploads, and delayed calls."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from fastapi import HTTPException
from nicegui import events, ui
from nicegui.element import Element

from clients.web.controls import NumberField
from clients.web.guard import plain_name

MAX_REPORTS = 2**53
"""Largest report number that a browser represents exactly."""


MAX_TYPED_CHARACTERS = 40


class Delayed:
    """A call after a delay; a newer one replaces it."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._timer: asyncio.TimerHandle | None = None

    def call(self, function: Callable[..., Any], *args: Any) -> None:
        """Call a function on the event loop after the delay."""
        self.cancel()
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(self._delay_s, function, *args)

    def cancel(self) -> None:
        """Cancel a call that has not started."""
        if self._timer is not None:
            self._timer.cancel()


def card(label: str, kind: str = "") -> ui.element:
    """Return a section of the page with an accessible name."""
    section = ui.element("section").classes(f"oc-card {kind}")
    return section.props(f'aria-label="{label}"')


def title(text: str, tag: str = "h2", kind: str = "oc-title") -> ui.html:
    """Return a heading."""
    return ui.html(text, tag=tag, sanitize=False).classes(kind)


def switch(label: str, value: bool, on_change: Callable[..., Any]) -> ui.switch:
    """Return a switch."""
    found = ui.switch(label, value=value, on_change=on_change)
    return found.props("dense").classes("oc-switch")


def small_button(label: str, on_click: Callable[..., Any]) -> ui.button:
    """Return a button of a group."""
    button = ui.button(label, on_click=on_click).props("outline dense no-caps size=sm")
    return button.classes("oc-download")


def help_button(subject: str, text: str) -> ui.button:
    """Return a button that opens an explanation."""
    with ui.button("?").props(
        f'flat dense round size=sm aria-label="Help: {subject}"'
    ) as button:
        button.classes("oc-help")
        with ui.menu().props(
            f'max-width="340px" role=dialog aria-label="Help: {subject}"'
        ):
            ui.label(text).classes("oc-help-text")
    return button


def more(label: str = "More", *, is_open: bool = False) -> ui.element:
    """Return a part that is folded until its label is pressed; use it as a context."""
    part = ui.element("details").classes("oc-more")
    part.props("open" if is_open else "")
    with part, ui.element("summary"):
        ui.label(label)
    return part


def problem_label() -> ui.label:
    """Return a label for errors, which screen readers announce."""
    return ui.label("").classes("oc-problem").props("role=alert")


def warn(text: str, kind: str = "warning") -> None:
    """Show a notification of something that was not done."""
    ui.notify(text, type=kind, position="top")


def toggle(
    options: Mapping[str, str],
    value: str,
    on_change: Callable[..., Any],
    *,
    label: str,
    props: str = "",
    kind: str = "",
) -> ui.toggle:
    """Return a row of buttons of which one is pressed."""
    return (
        ui.toggle(dict(options), value=value, on_change=on_change)
        .props(f'no-caps unelevated dense {props} role=group aria-label="{label}"')
        .classes(f"oc-toggle {kind}")
    )


def select(
    options: Any, value: Any, on_change: Callable[..., Any], *, label: str
) -> ui.select:
    """Return a list of which one option is chosen."""
    return ui.select(options, value=value, on_change=on_change, label=label).props(
        "outlined dense options-dense"
    )


# nicegui, which takes the name of the component, has no types here
class SliderRow(Element, component="range_slider.js"):  # type: ignore[call-arg]
    """A slider for one number, as a native range input.

    Parameters
    ----------
    number : its name, label, range, step and text
    value : initial value
    on_move : called with the name and each value
    is_titled : whether label and value are visible; always available to assistive
        technology
    """

    def __init__(
        self,
        number: NumberField,
        value: float,
        on_move: Callable[[str, float], None],
        *,
        is_titled: bool = True,
    ) -> None:
        super().__init__()
        self.number = number
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
        self.on("typed", lambda event: self._typed(event.args))

    def _moved(self, sent: object) -> None:
        match sent:
            case [int() | float() as value, int() as report_number] if type(
                report_number
            ) is int and not math.isnan(value):
                self._props["answered"] = min(report_number, MAX_REPORTS)
                self.show(self.number.clamped(value))
                self._on_move(self.number.name, self._props["value"])

    def _typed(self, sent: object) -> None:
        """Take a typed text, with or without a unit."""
        try:
            value = self.number.read_typed(str(sent)[:MAX_TYPED_CHARACTERS])
        except ValueError as error:
            warn(f"{self.number.label}: {error}")
            return
        self.move(value)

    def move(self, value: float) -> None:
        """Show a value and report it, as if the slider was moved."""
        self.show(value)
        self._on_move(self.number.name, value)

    def show(self, value: float) -> None:
        """Show a value."""
        self._props["value"] = value
        text = self._disabled_text or self.number.describe(value)
        self._props["text"] = text if self._is_titled else ""
        self.update()

    def enable(self, is_on: bool, disabled_text: str) -> None:
        """Enable the slider, or disable it and show a text in place of the value."""
        self._props["disabled"] = not is_on
        self._disabled_text = None if is_on else disabled_text
        self.show(self._props["value"])


HEADER = """
<div class="row no-wrap items-center q-px-sm" style="min-height: 40px">
  <span class="col">LABEL</span>
  <q-btn v-if="props.canAddFiles" icon="add" flat dense @click="props.pickFiles"
         aria-label="Choose a file: LABEL"></q-btn>
  <span style="display: none"><q-uploader-add-trigger></q-uploader-add-trigger></span>
</div>"""
"""Header of an upload; the buttons of Quasar's default have no accessible names."""

UploadHandler = Callable[[str, bytes], Awaitable[None]]


class _Upload(ui.upload):
    """Upload whose page may be closed by the time a file has arrived."""

    async def handle_uploads(self, files: list[Any]) -> None:
        """Pass the files on; raise an HTTP error if the page was closed.

        NiceGUI's own method raises an error that ends up in the log.
        """
        if self.is_deleted:
            raise HTTPException(410, "the page was closed")
        await super().handle_uploads(files)


def upload_entry(
    label: str, accept: str, max_bytes: int, on_file: UploadHandler
) -> ui.element:
    """Return a file upload that shows errors below it.

    Parameters
    ----------
    accept : as in HTML; the browser rejects other files itself, without a message
    max_bytes : size limit, checked before the file is in memory
    on_file : called with the name and content of each file; a ValueError is shown
    """
    allowed = "a picture" if accept == "image/*" else accept.replace(",", ", ")
    allowed += f", up to {max_bytes / 1e6:g} MB"

    def reject() -> None:
        problem.text = f"{label}: not such a file; allowed: {allowed}"

    async def check(event: events.UploadEventArguments) -> None:
        event.sender.reset()  # ready for the next file
        if event.file.size() > max_bytes:  # the browser should have rejected it
            reject()
            return
        problem.text = ""
        name = plain_name(event.file.name)
        try:
            await on_file(name, await event.file.read())
        except ValueError as error:
            text = str(error)
            problem.text = text if name in text else f"{name}: {text}"
        except RuntimeError:
            if not entry.is_deleted:  # otherwise the page was closed meanwhile
                raise

    with ui.element("div").classes("oc-upload-entry") as box:
        entry = _Upload(
            auto_upload=True,
            label=label,
            max_file_size=max_bytes,
            on_upload=check,
            on_rejected=reject,
        ).props(f'accept="{accept}" flat bordered')
        entry.classes("oc-upload")
        entry.add_slot("header", HEADER.replace("LABEL", label))
        problem = problem_label()
    return box
