"""Header of the page: downloads, the headset, and the link to the page's entries."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from nicegui import events, ui

from clients.headset.runtime import Eye
from clients.openxr_layer.wire import ask as ask_helper
from clients.openxr_layer.wire import socket_path
from clients.report import report_html
from clients.web.comparison import (
    EyeName,
    joined_png,
    label_of,
    short_label_of,
    side_of,
)
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import Ask, FigureFailed
from clients.web.page_link import fragment_of
from clients.web.page_state import PageState
from clients.web.picture_panel import PictureSender
from clients.web.widgets import Delayed, title, warn

EYE_OF_SIDE: Mapping[EyeSide, Eye] = {"OD": "right", "OS": "left"}

READY_S = 120.0
"""Maximum time that a download waits for the full picture."""

POLL_S = 0.05
UPDATE_DELAY_S = 0.5
"""Delay after the last change before the address in the browser is updated."""

READ = """
window.addEventListener("hashchange",
  () => emitEvent("oc-fragment", location.hash.slice(1)));
return location.hash.slice(1);
"""
SKIP = """() => {
  const part = document.querySelector("%s");
  part.scrollIntoView();
  part.tabIndex = -1;  // not a button in it, which would take the same Enter
  part.focus();
}"""
COPY = """
const link = location.origin + "/?token=" + TOKEN + location.hash;
if (navigator.clipboard) navigator.clipboard.writeText(link);
else {  // no clipboard API over HTTP from another machine
  const text = document.body.appendChild(document.createElement("textarea"));
  text.value = link;
  text.select();
  document.execCommand("copy");
  text.remove();
}
"""


REPORT_TIP = (
    "Report through pupils of 3 and 5 mm, HTML: open it in a browser and print it, or "
    "save it as PDF"
)

Action = Callable[[], Awaitable[None]]


def _reported(act: Action) -> Action:
    """Return a handler that shows why its action failed."""

    async def handle() -> None:
        try:
            await act()
        except (OSError, ValueError, FigureFailed) as error:
            warn(str(error), "negative")

    return handle


class Header:
    """Buttons for downloads and the link, and the fragment of the browser's address.

    A button shows the eyes in the program of a running `ocufilter layer`.

    Parameters
    ----------
    ask : runs a function in the worker process, for this page
    token : the access token, part of a copied link
    scene : returns the selected scene
    on_fragment : called with the new fragment when the address of the open page changes
    """

    def __init__(
        self,
        state: PageState,
        sender: PictureSender,
        ask: Ask,
        token: str,
        *,
        scene: Callable[[], str],
        on_fragment: Callable[[str], None],
    ) -> None:
        self._state, self._sender, self._ask = state, sender, ask
        self._token, self._scene, self._on_fragment = token, scene, on_fragment
        self._fragment: str | None = None  # not read yet
        self._update = Delayed(UPDATE_DELAY_S)
        with ui.element("header").classes("oc-header"):
            for label, css in (("picture", ".oc-picture"), ("entries", ".oc-eyes")):
                with ui.element("button").classes("oc-skip") as skip:
                    skip.props("type=button").on("click", js_handler=SKIP % css)
                    ui.label(f"Skip to the {label}")
            title("ocufilter", "h1", "oc-brand")
            ui.label("See through another person’s eyes").classes("oc-motto")
            ui.label("Not a medical device").classes("oc-hint oc-not-medical")
            ui.element("span").classes("oc-grow")
            self._nav = ui.element("nav").classes("oc-downloads")
            self._nav.props("aria-label=Downloads")
        buttons: list[tuple[str, str, str, Action]] = [
            ("Picture", "image", "The image that the eye sees, PNG", self._picture),
            ("Profile", "badge", "The eye's profile, JSON", self._profile),
            ("Report", "article", REPORT_TIP, self._report),
            (
                *("Copy link", "link"),
                "Link to these entries, including the access token",
                self._copy_link,
            ),
        ]
        if socket_path().is_socket():
            tip = "Show this eye in the program that runs with `ocufilter layer`"
            buttons.append(("Headset", "view_in_ar", tip, self._headset))
        with self._nav:
            for label, icon, tip, act in buttons:
                ui.button(label, icon=icon, on_click=_reported(act)).props(
                    f'outline dense no-caps size=sm aria-label="{label}"'
                ).classes("oc-download").tooltip(tip)
        ui.on("oc-fragment", self._change_fragment)

    # Downloads

    async def _picture(self) -> None:
        state = self._state
        if state.empty_reason:
            warn(state.empty_reason)
            return
        names = state.names
        try:
            async with asyncio.timeout(READY_S):
                for name in names:  # wait for an eye that is still being prepared
                    while not self._sender.is_final(name, state.number):
                        await asyncio.sleep(POLL_S)
        except TimeoutError:
            warn("The full picture is not ready yet")
            return
        seen = {name: self._sender.last[name] for name in names}
        if any(picture.kind != "full" for picture in seen.values()):
            warn("There is no picture of these entries")
            return
        if state.is_comparing:
            labels = [label_of(name, state.valid_profiles[name]) for name in names]
            pictures = [picture.data for picture in seen.values()]
            joined = await asyncio.to_thread(joined_png, pictures, labels)
            ui.download(joined, f"ocufilter_{state.sides[0]}_A_B.png")
            return
        for name, picture in seen.items():
            ui.download(picture.data, f"ocufilter_{name}.png")

    async def _report(self) -> None:
        state = self._state
        bodies = {name: state.profile_at_gaze(name) for name in state.names}
        known = {name: body for name, body in bodies.items() if body is not None}
        if state.is_comparing and len(known) == len(state.names):
            before, after = known.values()
            await self._write_report(
                f"{SIDES[state.sides[0]].lower()}, A and B",
                f"{state.sides[0]}_A_B",
                *(before, after),
                label=short_label_of(state.names[0], before),
                after_label=short_label_of(state.names[1], after),
            )
            return
        for name, body in known.items():
            label = SIDES[side_of(name)]
            await self._write_report(label.lower(), name, body, label=label)

    async def _write_report(
        self, subject: str, file_name: str, *bodies: dict[str, Any], **labels: str
    ) -> None:
        """Write a report on one profile or on two, and download it."""
        waiting = ui.notification(
            f"Writing the report on the {subject}…",
            spinner=True,
            timeout=None,
            position="top",
        )
        try:
            kind = f"report {file_name}"
            notation = self._state.notation
            text = await self._ask(
                kind, report_html, *bodies, **labels, notation=notation
            )
        finally:
            waiting.dismiss()
        if text is not None:
            ui.download(text.encode(), f"ocufilter_{file_name}.html")

    async def _profile(self) -> None:
        for name in self._state.names:
            text = json.dumps(self._state.body(name), indent=1)
            file_name = f"{self._file_name(name)}.json"
            ui.download(text.encode(), f"ocufilter_{file_name}")

    def _file_name(self, name: EyeName) -> str:
        return f"{name}_A" if self._state.is_comparing and name in SIDES else name

    async def _headset(self) -> None:
        eyes: dict[str, str] = {
            EYE_OF_SIDE[side]: json.dumps(self._state.body(side))
            for side in self._state.sides
        }
        answer = await asyncio.to_thread(ask_helper, socket_path(), eyes)
        warn(f"Sent to {answer['program'] or 'the next program'}", "positive")

    # Link

    async def read_fragment(self) -> str | None:
        """Return the fragment that the page was opened with; None if the browser left.

        The address is not written before that, as it would replace the fragment.
        """
        try:
            self._fragment = str(await ui.run_javascript(READ, timeout=10.0))
        except TimeoutError:
            return None
        return self._fragment

    def _change_fragment(self, event: events.GenericEventArguments) -> None:
        fragment: Any = event.args
        if isinstance(fragment, str) and fragment not in ("", self._fragment):
            self._fragment = fragment
            self._on_fragment(fragment)

    def schedule_update(self) -> None:
        """Write the entries to the browser's address after a delay without changes."""
        self._update.call(self._write)

    def _write(self) -> None:
        # an upload may end after its page was closed
        if self._fragment is None or self._nav.is_deleted:
            return
        fragment = fragment_of(self._state, self._scene())
        if fragment != self._fragment:
            self._fragment = fragment
            with self._nav:
                ui.run_javascript(f'history.replaceState(null, "", "#{fragment}")')

    async def _copy_link(self) -> None:
        """Copy a link to the entries that contains the token."""
        self._write()
        ui.run_javascript(COPY.replace("TOKEN", json.dumps(self._token)))
        ui.notify(
            "Link copied. Anyone who has it can use this page; it does not contain "
            "uploaded files.",
            position="top",
            timeout=6000,
        )

    def cancel(self) -> None:
        """Cancel the pending update."""
        self._update.cancel()
