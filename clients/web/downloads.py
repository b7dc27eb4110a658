"""Downloads of a page: picture, profile and report; and a program's headset."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui

from clients.headset.runtime import Eye
from clients.openxr_layer.wire import ask, socket_path
from clients.report import report_html
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import FigureFailed, FigureWorker
from clients.web.page_state import PageState
from clients.web.picture_sender import PictureSender

EYE_OF_SIDE: Mapping[EyeSide, Eye] = {"OD": "right", "OS": "left"}

READY_S = 120.0
"""Maximum time that a download waits for the full picture."""


class Downloads:
    """Buttons that download the picture, the profile and the report.

    Another button shows the eyes in the program of a running `ocufilter layer`.

    Parameters
    ----------
    page : str
        Page that owns the requests.
    ready : events that are set while the full picture of each eye is shown
    empty_reason : returns why there is no picture, or an empty string
    """

    def __init__(
        self,
        page: str,
        state: PageState,
        sender: PictureSender,
        figure_worker: FigureWorker,
        *,
        ready: Mapping[EyeSide, asyncio.Event],
        empty_reason: Callable[[], str],
    ) -> None:
        self._page, self._state, self._sender = page, state, sender
        self._figure_worker, self._ready = figure_worker, ready
        self._empty_reason = empty_reason

    def build(self, on_copy: Callable[[], None]) -> None:
        """Build the download buttons and the button that copies the link."""
        with ui.element("nav").classes("oc-downloads").props("aria-label=Downloads"):
            for label, icon, tip, act in (
                (
                    "Picture",
                    "download",
                    "The image that the eye sees, PNG",
                    self._picture,
                ),
                ("Profile", "download", "The eye's profile, JSON", self._profile),
                (
                    *("Report", "download", "Report on this eye, HTML"),
                    self._report,
                ),
                (
                    *(
                        "Copy link",
                        "link",
                        "Link to these entries, including the access token",
                    ),
                    on_copy,
                ),
            ):
                _button(label, icon, tip, act)
            if socket_path().is_socket():
                tip = "Show this eye in the program that runs with `ocufilter layer`"
                _button("Headset", "view_in_ar", tip, self._headset)

    async def _picture(self) -> None:
        if self._empty_reason():
            ui.notify(self._empty_reason(), type="warning", position="top")
            return
        sides = self._state.sides
        for side in sides:  # wait for an eye that is still being prepared
            try:
                await asyncio.wait_for(self._ready[side].wait(), READY_S)
            except TimeoutError:
                ui.notify(
                    "The full picture is not ready yet", type="warning", position="top"
                )
                return
        for side in sides:
            seen = self._sender.last(side)
            if seen is not None and seen.kind == "full":
                ui.download(seen.data, f"ocufilter_{side}.png")

    async def _report(self) -> None:
        for side in self._state.sides:
            body = self._state.profile_at_gaze(side)
            if body is None:
                continue
            title = SIDES[side]
            waiting = ui.notification(
                f"Writing the report on the {title.lower()}…",
                spinner=True,
                timeout=None,
                position="top",
            )
            try:
                text = await self._figure_worker.ask(
                    self._page, f"report {side}", report_html, body, label=title
                )
            except FigureFailed as error:
                ui.notify(str(error), type="negative", position="top")
                continue
            finally:
                waiting.dismiss()
            if text is not None:
                ui.download(text.encode(), f"ocufilter_{side}.html")

    def _profile(self) -> None:
        for side in self._state.sides:
            try:
                text = json.dumps(self._state.body(side), indent=1)
            except ValueError as error:
                ui.notify(str(error), type="negative", position="top")
                return
            ui.download(text.encode(), f"ocufilter_{side}.json")

    async def _headset(self) -> None:
        try:
            eyes: dict[str, str] = {
                EYE_OF_SIDE[side]: json.dumps(self._state.body(side))
                for side in self._state.sides
            }
            answer = await asyncio.to_thread(ask, socket_path(), eyes)
        except (OSError, ValueError) as error:
            ui.notify(str(error), type="negative", position="top")
            return
        shown = answer["program"] or "the next program"
        ui.notify(f"Sent to {shown}", type="positive", position="top")


def _button(label: str, icon: str, tip: str, act: Callable[[], Any]) -> None:
    ui.button(label, icon=icon, on_click=act).props(
        "outline dense no-caps size=sm"
    ).classes("oc-download").tooltip(tip)
