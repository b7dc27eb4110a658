"""Downloads of a page: picture, profile and report."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping

from nicegui import ui

from clients.report import report_html
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import FigureWorker, StudyFailed
from clients.web.page_state import PageState
from clients.web.picture_sender import PictureSender

READY_S = 120.0
"""Longest time that a download waits for the full picture."""


class Downloads:
    """Buttons that download what the page shows.

    Parameters
    ----------
    page : str
        Page that owns the requests.
    ready : whether the full picture of each eye is shown
    no_scene : returns why there is no picture, or an empty text
    """

    def __init__(
        self,
        page: str,
        state: PageState,
        out: PictureSender,
        figure_worker: FigureWorker,
        *,
        ready: Mapping[EyeSide, asyncio.Event],
        no_scene: Callable[[], str],
    ) -> None:
        self._page, self._state, self._out = page, state, out
        self._figure_worker, self._ready = figure_worker, ready
        self._no_scene = no_scene

    def build(self, on_copy: Callable[[], None]) -> None:
        """Build the buttons, and the one that copies the link."""
        with ui.element("nav").classes("oc-downloads").props("aria-label=Downloads"):
            for label, icon, tip, act in (
                ("Picture", "download", "What the eye sees, PNG", self._picture),
                ("Profile", "download", "The eye's profile, JSON", self._profile),
                (
                    *("Report", "download", "What this eye sees and why, HTML"),
                    self._report,
                ),
                (
                    *("Copy link", "link", "Link to these entries, with access"),
                    on_copy,
                ),
            ):
                ui.button(label, icon=icon, on_click=act).props(
                    "outline dense no-caps size=sm"
                ).classes("oc-download").tooltip(tip)

    async def _picture(self) -> None:
        if self._no_scene():
            ui.notify(self._no_scene(), type="warning", position="top")
            return
        sides = self._state.sides
        for side in sides:  # a click while the eye is prepared waits for it
            try:
                await asyncio.wait_for(self._ready[side].wait(), READY_S)
            except TimeoutError:
                ui.notify(
                    "The full picture is not ready yet", type="warning", position="top"
                )
                return
        for side in sides:
            seen = self._out.last(side)
            if seen is not None and seen.kind == "full":
                ui.download(seen.data, f"ocufilter_{side}.png")

    async def _report(self) -> None:
        for side in self._state.sides:
            body = self._state.looking_body(side)
            if body is None:
                continue
            title = SIDES[side]
            waiting = ui.notification(
                f"Writing the report: {title.lower()} …",
                spinner=True,
                timeout=None,
                position="top",
            )
            try:
                text = await self._figure_worker.ask(
                    self._page, f"report {side}", report_html, body, label=title
                )
            except StudyFailed as error:
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
