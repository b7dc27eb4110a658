"""The page: layout and event handlers."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from nicegui import Client, app, events, ui

from clients.report import report_html
from clients.web.eye_form import SIDES, EyeSide
from clients.web.eye_panel import EyePanel
from clients.web.figure_panel import FigurePanel
from clients.web.figure_worker import FigureWorker, StudyFailed
from clients.web.filter_thread import FilterThread
from clients.web.numbers import distance_text
from clients.web.page_state import AGE, DISTANCE, FOCUS, LOOKS, PUPIL, PageState
from clients.web.picture import Picture
from clients.web.picture_files import png_of
from clients.web.picture_requests import SentPicture
from clients.web.picture_sender import PictureSender
from clients.web.picture_view import PictureView
from clients.web.scene_panel import ScenePanel
from clients.web.slider_row import SliderRow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STYLE = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
SHOWN = {"OD": "Right eye", "OS": "Left eye", "both": "Both"}
FIGURES_REST_S = 0.35
"""Time after the last change until figures are redrawn."""

FIRST_ASPECT = 960 / 540
PICTURES_PATH = "/pictures/"


NamedProfile = tuple[Mapping[str, Any], str]


class SharedResources:
    """Resources shared by all pages of a process."""

    def __init__(self) -> None:
        self.filter_thread = FilterThread()
        self.figure_worker = FigureWorker()
        self.out: dict[str, PictureSender] = {}

    def close(self) -> None:
        """Stop the thread and the process; closing twice is allowed."""
        self.filter_thread.close()
        self.figure_worker.close()


class Page:
    """One page in one browser.

    Parameters
    ----------
    profile : initial profile of both eyes, and its name
    """

    def __init__(
        self, resources: SharedResources, profile: NamedProfile | None
    ) -> None:
        self.resources = resources
        self.name = secrets.token_urlsafe(16)
        self.state = PageState()
        if profile is not None:
            self._set_profile(*profile)
        self.out = resources.out[self.name] = PictureSender()
        self._loop = asyncio.get_running_loop()
        self._renewal: asyncio.Task[None] | None = None
        resources.filter_thread.open(self.name, self._from_thread)
        self._build()

    def _set_profile(self, body: Mapping[str, Any], name: str) -> None:
        for form in self.state.eyes.values():
            form.take_body(body, name)
        self.state.values[AGE.name] = body.get(AGE.name, self.state.values[AGE.name])

    # Layout

    def _build(self) -> None:
        ui.add_css(STYLE)
        ui.colors(primary="#1f5fa8", negative="#b3262e", positive="#2c8a57")
        ui.context.client.content.classes("oc-content")
        with ui.element("header").classes("oc-header"):
            ui.label("ocufilter").classes("oc-brand")
            ui.label("See through another person’s eyes").classes("oc-motto")
            ui.element("span").classes("oc-grow")
            self._download_buttons()
        with ui.element("main").classes("oc-page"):
            with ui.element("div").classes("oc-middle"):
                self._picture_card()
                self._sliders_card()
            with ui.element("div").classes("oc-left"):
                self._eyes_card()
            with ui.element("div").classes("oc-right"):
                self.figures = FigurePanel(
                    self.name, self.state, self.resources.figure_worker
                )
        ui.timer(0.0, self.scene.first, once=True)

    def _download_buttons(self) -> None:
        for label, tip, act in (
            ("Picture", "What the eye sees, PNG", self._download_picture),
            ("Profile", "The eye's profile, JSON", self._download_profile),
            ("Report", "What this eye sees and why, HTML", self._download_report),
        ):
            ui.button(label, icon="download", on_click=act).props(
                "outline dense no-caps size=sm"
            ).classes("oc-download").tooltip(tip)

    def _picture_card(self) -> None:
        with ui.element("section").classes("oc-card oc-picture"):
            self.scene = ScenePanel(self.state, self._set_picture)
            self.view = PictureView(
                PICTURES_PATH + self.name, list(self.state.sides), FIRST_ASPECT
            )
            self.view.on("point", self._point)
            self.view.on("look", self._look)
            self._note = ui.label("").classes("oc-note")
            self._notes: dict[EyeSide, str] = {}

    def _sliders_card(self) -> None:
        values = self.state.values
        with ui.element("section").classes("oc-card oc-sliders"):
            self.rows = {
                number.name: SliderRow(
                    number,
                    values[number.name],
                    cast(
                        "Callable[[float], None]",
                        lambda value, name=number.name: self._slide(name, value),
                    ),
                    words=distance_text if number in (FOCUS, DISTANCE) else None,
                )
                for number in LOOKS
            }

    def _eyes_card(self) -> None:
        with ui.element("section").classes("oc-card"):
            with ui.element("div").classes("oc-line"):
                ui.label("The eye").classes("oc-title")
                self._copy = ui.button(
                    "copy to the other", on_click=self._copy_eye
                ).props("flat dense no-caps size=sm")
            ui.toggle(SHOWN, value=self.state.shown, on_change=self._show).props(
                "no-caps unelevated spread dense"
            ).classes("oc-toggle oc-shown")
            self.panels: dict[EyeSide, EyePanel] = {}
            self._boxes: dict[EyeSide, tuple[ui.element, ui.label]] = {}
            for side, title in SIDES.items():
                with ui.element("div").classes("oc-eye-box") as box:
                    heading = ui.label(title).classes("oc-eye-title")
                    self.panels[side] = EyePanel(
                        self.state.eyes[side], self.request, self._set_age
                    )
                self._boxes[side] = (box, heading)
            self._show_boxes()
            self._problem = ui.label("").classes("oc-problem")

    # Event handlers

    def request(self) -> None:
        """Request a picture for the current entries; report invalid entries."""
        request = self.state.request()
        problems = self.state.problems()
        if problems and self.state.right:
            problems.append("The pictures show the last valid entries.")
        self._problem.text = "\n".join(problems)
        if request is None:
            return
        self.resources.filter_thread.request(self.name, request)
        if self._renewal is not None:
            self._renewal.cancel()
        self._renewal = asyncio.create_task(self._renew_figures())

    async def _renew_figures(self) -> None:
        await asyncio.sleep(FIGURES_REST_S)
        self._renewal = None  # from here on it is not canceled: newer ones wait
        await self.figures.renew()

    def _slide(self, name: str, value: float) -> None:
        self.state.values[name] = value
        self.request()

    def _set_age(self, age_years: float) -> None:
        self.state.values[AGE.name] = age_years
        self.rows[AGE.name].show(age_years)

    def _set_picture(self, picture: Picture) -> None:
        self.state.set_picture(picture)
        for name in (PUPIL.name, FOCUS.name, DISTANCE.name):
            self.rows[name].show(self.state.values[name])
        self.rows[DISTANCE.name].enable(
            picture.distance_dpt is not None, "as in the picture"
        )
        self.view.show_aspect(picture.aspect_ratio)
        number = self.state.number + 1
        self.out.put(
            SentPicture(
                "scene",
                None,
                number,
                png_of(cast("NDArray[np.uint8]", picture.view.color)),
            )
        )
        self.request()

    def _show(self, event: events.ValueChangeEventArguments) -> None:
        self.state.shown = event.value
        self._show_boxes()
        self.view.show_eyes(list(self.state.sides))
        self._show_notes()
        self._copy.set_visibility(self.state.shown != "both")
        self.request()

    def _show_boxes(self) -> None:
        for side, (box, heading) in self._boxes.items():
            box.set_visibility(side in self.state.sides)
            heading.set_visibility(self.state.shown == "both")

    def _copy_eye(self) -> None:
        side = self.state.sides[0]
        other = next(s for s in SIDES if s != side)
        self.panels[other].copy(self.state.eyes[side])
        ui.notify(f"{SIDES[other]}: as the {SIDES[side].lower()}", timeout=2000)

    async def _point(self, event: events.GenericEventArguments) -> None:
        if event.args["eye"] in SIDES:
            await self.figures.point(event.args["eye"], *_share(event))

    def _look(self, event: events.GenericEventArguments) -> None:
        self.state.look_at(*_share(event))
        self.rows[FOCUS.name].show(self.state.values[FOCUS.name])
        self.request()

    # Pictures from the filter thread

    def _from_thread(self, seen: SentPicture) -> None:
        self._loop.call_soon_threadsafe(self._show_picture, seen)

    def _show_picture(self, seen: SentPicture) -> None:
        self.out.put(seen)
        if seen.kind in ("full", "failed"):
            assert seen.eye is not None
            notes = seen.facts.get("notes") or [seen.facts.get("error", "")]
            self._notes[seen.eye] = " ".join(_sentence(note) for note in notes if note)
            self._show_notes()

    def _show_notes(self) -> None:
        lines = [(SIDES[side], self._notes.get(side)) for side in self.state.sides]
        if len(lines) == 1:
            self._note.text = lines[0][1] or ""
        else:
            told = [f"{title}: {text}" for title, text in lines if text]
            self._note.text = "\n".join(told)

    # Downloads

    async def _download_picture(self) -> None:
        sides = [s for s in self.state.sides if self._full(s) is not None]
        if not sides:
            ui.notify("The full picture is not ready yet", type="warning")
        for side in sides:
            ui.download(
                cast(SentPicture, self._full(side)).data, f"ocufilter_{side}.png"
            )

    async def _download_report(self) -> None:
        for side in self.state.sides:
            body = self.state.looking_body(side)
            if body is None:
                continue
            title = SIDES[side]
            waiting = ui.notification(
                f"Writing the report: {title.lower()} …", spinner=True, timeout=None
            )
            try:
                text = await self.resources.figure_worker.ask(
                    self.name, f"report {side}", report_html, body, label=title
                )
            except StudyFailed as error:
                ui.notify(str(error), type="negative")
                continue
            finally:
                waiting.dismiss()
            if text is not None:
                ui.download(text.encode(), f"ocufilter_{side}.html")

    def _full(self, side: EyeSide) -> SentPicture | None:
        seen = self.out.last(side)
        return seen if seen is not None and seen.kind == "full" else None

    def _download_profile(self) -> None:
        for side in self.state.sides:
            try:
                text = json.dumps(self.state.body(side), indent=1)
            except ValueError as error:
                ui.notify(str(error), type="negative")
                return
            ui.download(text.encode(), f"ocufilter_{side}.json")

    def close(self) -> None:
        """Release the page's resources."""
        self.resources.filter_thread.forget(self.name)
        self.resources.figure_worker.forget(self.name)
        self.resources.out.pop(self.name, None)


def _share(event: events.GenericEventArguments) -> tuple[float, float]:
    """Return a position in the picture, clamped to 0, 0 to 1, 1."""
    x, y = (min(max(float(event.args[name]), 0.0), 1.0) for name in "xy")
    return x, y


def _sentence(note: str) -> str:
    return note[:1].upper() + note[1:].rstrip(".") + "."


def add_page(resources: SharedResources, profile: NamedProfile | None) -> None:
    """Serve the page at `/`."""

    @ui.page("/", title="ocufilter")
    async def _page(client: Client) -> None:
        page = Page(resources, profile)
        client.on_delete(page.close)

    app.on_shutdown(resources.close)
