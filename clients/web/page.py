"""The page: layout and event handlers."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Response
from fastapi.responses import HTMLResponse
from nicegui import Client, app, background_tasks, events, run, ui

from clients.web.controls import (
    AGE,
    CONDITIONS,
    DISTANCE,
    FOCUS,
    PUPIL,
    NumberField,
    distance_text,
)
from clients.web.eye_form import SIDES, EyeSide
from clients.web.eye_panel import EyePanel
from clients.web.figure_panel import FigurePanel
from clients.web.figure_worker import FigureWorker
from clients.web.filter_thread import FilterThread, SentPicture
from clients.web.guard import FULL, MAX_PAGES, page_of
from clients.web.header import Header
from clients.web.page_state import SCENES, PageState, restore
from clients.web.picture import Picture, SceneNotRendered, png_of, scene_picture
from clients.web.picture_panel import PictureSender, PictureView, ScenePanel
from clients.web.widgets import (
    Delayed,
    SliderRow,
    card,
    problem_label,
    title,
    toggle,
)

STYLE = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
SHOWN = {"OD": "Right eye", "OS": "Left eye", "both": "Both"}
PIPELINES = {"exact": "Exact", "published": "Method of 2023 (slow)"}
"""Names of `filter_service.settings.Pipeline`."""

FIGURES_DELAY_S = 0.35
"""Delay after the last change before figures are redrawn."""

DEFAULT_ASPECT = 960 / 540
STATUS_DELAY_S = 0.3
"""Delay before the preparation of an eye is announced; most eyes are ready sooner."""

SCENE_WAIT_S = 1.5
"""Maximum time that a page waits for the default scene before it opens without one."""

CONNECT_S = 30.0
RESPONSE_S = 120.0
"""Time limit for building a page.  It takes 0.35 s, and pages are built one at a time:
as many as may be open wait for each other."""

AMPLITUDE = (
    "The amplitude is objective accommodation; a push-up measurement also includes "
    "the depth of focus and is higher."
)

PICTURES_PATH = "/pictures/"

NamedProfile = tuple[Mapping[str, Any], str]


class SharedResources:
    """Resources shared by all pages of a process."""

    def __init__(self) -> None:
        self.filter_thread = FilterThread()
        self.figure_worker = FigureWorker()
        self.picture_senders: dict[str, PictureSender] = {}

    @property
    def are_full(self) -> bool:
        """Return whether the maximum number of pages is open."""
        return len(self.picture_senders) >= MAX_PAGES

    def close(self) -> None:
        """Stop the thread and the process; closing twice is allowed."""
        self.filter_thread.close()
        self.figure_worker.close()


class Page:
    """One page in one browser.

    Parameters
    ----------
    profile : initial profile of both eyes, and its name
    token : the access token, part of a copied link
    """

    def __init__(
        self, resources: SharedResources, profile: NamedProfile | None, token: str
    ) -> None:
        self.resources = resources
        self.name = secrets.token_urlsafe(16)
        self.state = PageState()
        if profile is not None:
            for side in SIDES:
                self.state.load_body(side, *profile)
        self.sender = resources.picture_senders[self.name] = PictureSender()
        self._figure_refresh = Delayed(FIGURES_DELAY_S)
        self._announcement = Delayed(STATUS_DELAY_S)
        self._notes: dict[EyeSide, str] = {}
        self.rows: dict[str, SliderRow] = {}
        loop = asyncio.get_running_loop()
        resources.filter_thread.open(
            self.name,
            lambda seen: loop.call_soon_threadsafe(self._show_picture, seen),
        )
        self._build(token)

    # Layout

    def _build(self, token: str) -> None:
        ui.add_css(STYLE)
        ui.colors(primary="#1f5fa8", negative="#b3262e", positive="#2c8a57")
        ui.context.client.content.classes("oc-content")
        ask = partial(self.resources.figure_worker.ask, self.name)
        self.header = Header(
            *(self.state, self.sender, ask, token),
            scene=lambda: self.scene.kind,
            on_fragment=self._restore,
        )
        self.figures = FigurePanel(self.state, ask)
        with ui.element("div").classes("oc-page"):  # NiceGUI adds the <main>
            with ui.element("div").classes("oc-columns"):
                with ui.element("div").classes("oc-left"):
                    self._eyes_card()
                    self.figures.build_point()
                with ui.element("div").classes("oc-middle"):
                    self._picture_card()
                    self._sliders_card()
            self.figures.build_figure()

    def _picture_card(self) -> None:
        state = self.state
        with card("Picture", "oc-picture"):
            self.scene = ScenePanel(state, self._set_picture, self._set_empty)
            self.view = PictureView(
                PICTURES_PATH + self.name, state.sides, DEFAULT_ASPECT
            )
            self.view.on("point", self._point)
            self.view.on("look", self._focus)
            self._status = ui.label("").classes("oc-status")
            self._status.props("role=status aria-live=polite")
            self._note = ui.label("").classes("oc-note").props("aria-live=polite")
            self._scene_problem = problem_label()

    def _sliders_card(self) -> None:
        with card("Viewing conditions", "oc-sliders"):
            for number in CONDITIONS:
                if number is not AGE:
                    self._slider(number)
            with (
                ui.element("div").classes("oc-look").props("role=group aria-label=Look")
            ):
                ui.label("Look").props("aria-hidden=true")
                for label, is_reading in (("Far", False), ("Reading", True)):
                    ui.button(label, on_click=partial(self._look, is_reading)).props(
                        "outline dense no-caps size=sm"
                    ).classes("oc-download")
                ui.element("span").classes("oc-grow")
                self._pipelines = toggle(
                    *(PIPELINES, self.state.pipeline, self._choose_pipeline),
                    label="Method",
                    props="size=sm",
                )

    def _slider(self, number: NumberField) -> None:
        value = self.state.values[number.name]
        self.rows[number.name] = SliderRow(number, value, self._slide)

    def _eyes_card(self) -> None:
        with card("Eye"):
            with ui.element("div").classes("oc-line"):
                title("The eye")
                self._copy = ui.button("Copy to the other eye", on_click=self._copy_eye)
                self._copy.props("flat dense no-caps size=sm")
            self._shown = toggle(
                *(SHOWN, self.state.shown, self._show),
                label="Eyes shown",
                props="spread",
                kind="oc-shown",
            )
            self._slider(AGE)
            self.panels = {
                side: EyePanel(form, self._change_eye, self._take_file)
                for side, form in self.state.eyes.items()
            }
            self._show_boxes()
            self._problem = problem_label()

    # Entries

    async def start(self) -> None:
        """Restore the entries from the address; the browser must be connected."""
        fragment = await self.header.read_fragment()
        if fragment:
            self._restore(fragment)
        else:
            self.header.schedule_update()

    def _restore(self, fragment: str) -> None:
        """Restore the entries from a fragment of the address."""
        found = restore(self.state, fragment)
        for panel in self.panels.values():
            panel.build.refresh()
        self._show_values()
        self._pipelines.value = self.state.pipeline
        self._shown.value = self.state.shown  # shows the eyes, too
        self._scene_problem.text = " ".join(found.problems)
        # links never contain a photo: keep it unless the link selects another scene
        keeps_file = found.scene == SCENES[0] and self.scene.kind not in SCENES
        if found.scene in (None, self.scene.kind) or keeps_file:
            self.request()
        else:
            self.scene.choose(found.scene)

    def _show_values(self) -> None:
        for name, row in self.rows.items():
            row.show(self.state.values[name])

    def _change_eye(self) -> None:
        """Request a picture if a profile has changed; report invalid entries."""
        if self.state.read_profiles():
            self.request()
        else:
            self._report_problems()
            self.header.schedule_update()

    def _report_problems(self) -> None:
        problems = self.state.problems()
        if problems and self.state.valid_profiles:
            problems.append("The pictures show the last valid entries.")
        self._problem.text = "\n".join(problems)

    def request(self) -> None:
        """Request a picture for the current entries; report invalid entries."""
        request = self.state.request()
        self._report_problems()
        if request is None:
            return
        self.view.show(alts={side: self._alt(side) for side in self.state.sides})
        self._announcement.call(
            self._status.set_text,
            f"Preparing the {self.state.titles}: estimating the eye model and "
            "computing point-spread functions…",
        )
        self.header.schedule_update()
        self.resources.filter_thread.request(self.name, request)
        self._figure_refresh.call(
            lambda: background_tasks.create(self._refresh_figures())
        )

    def _alt(self, side: EyeSide) -> str:
        """Return the text alternative of an eye's picture."""
        values, picture = self.state.values, self.state.picture
        scene = picture.title if picture is not None else "scene"
        return (
            f"{scene} as the {SIDES[side].lower()} sees it through a pupil of "
            f"{values[PUPIL.name]:.1f} mm, focused at "
            f"{distance_text(values[FOCUS.name])}"
        )

    async def _refresh_figures(self) -> None:
        picture = self.state.picture
        if picture is not None:
            # label the rows of a chart; mark the smallest one that each eye can read
            read = await self.figures.smallest_rows()
            shown = self.state.picture
            if read is not None and shown and shown.chart_rows == picture.chart_rows:
                self.view.mark_rows(shown, read)
        await self.figures.refresh()

    def _slide(self, name: str, value: float) -> None:
        self.state.move(name, value)
        if name == DISTANCE.name:
            self.rows[FOCUS.name].show(self.state.values[FOCUS.name])
        self.request()

    def _look(self, is_reading: bool) -> None:
        self.state.look(is_reading=is_reading)
        self._show_values()
        self.request()

    def _choose_pipeline(self, event: events.ValueChangeEventArguments) -> None:
        self.state.pipeline = event.value
        self.request()

    async def _take_file(self, side: EyeSide, name: str, content: bytes) -> None:
        loaded_side = self.state.load_file(side, name, content)
        self._show_values()
        for panel in self.panels.values():
            panel.build.refresh()
        if loaded_side != side:
            ui.notify(
                f"{name} is a profile of the {SIDES[loaded_side].lower()} and "
                "was loaded there",
                position="top",
                timeout=6000,
            )
        if loaded_side in (side, *self.state.sides):
            self.request()
        else:
            self._shown.value = loaded_side  # requests it

    def _show(self, event: events.ValueChangeEventArguments) -> None:
        self.state.shown = event.value
        self._show_boxes()
        self.view.show(eyes=list(self.state.sides))
        self._show_notes()
        self._copy.set_visibility(self.state.shown != "both")
        self.request()

    def _show_boxes(self) -> None:
        for side, panel in self.panels.items():
            panel.box.set_visibility(side in self.state.sides)
            panel.heading.set_visibility(self.state.shown == "both")

    def _copy_eye(self) -> None:
        side = self.state.sides[0]
        other = next(s for s in SIDES if s != side)
        self.state.eyes[other].copy(self.state.eyes[side])
        self.panels[other].changed()
        ui.notify(
            f"{SIDES[other]}: as the {SIDES[side].lower()}",
            position="top",
            timeout=2000,
        )

    async def _point(self, event: events.GenericEventArguments) -> None:
        if event.args["eye"] in SIDES:
            await self.figures.point(event.args["eye"], *_position(event))

    def _focus(self, event: events.GenericEventArguments) -> None:
        self.state.look_at(*_position(event))
        self._show_values()
        self.request()

    # Pictures

    def show_default_scene(self, picture: asyncio.Future[Picture]) -> None:
        """Show the default scene, or the reason that it cannot be rendered."""
        try:
            self._set_picture(picture.result())
        except SceneNotRendered as error:
            self._scene_problem.text = str(error)

    def _set_empty(self, text: str) -> None:
        """Show a text in place of the picture; an empty one shows the picture."""
        self.state.empty_reason = text
        self.view.show(empty=text)
        self._status.set_visibility(not text)
        self._note.set_visibility(not text)

    def _set_picture(self, picture: Picture) -> None:
        self.state.set_picture(picture)
        self._show_values()
        self.rows[DISTANCE.name].enable(
            picture.distance_dpt is not None, "as in the picture"
        )
        self._set_empty("")
        aspect = picture.view.width_px / picture.view.height_px
        self.view.show(scene=picture.title, aspect=aspect)
        self.view.mark_rows(picture, {})
        number, data = self.state.number + 1, png_of(picture.view.color)
        self.sender.put(SentPicture("scene", None, number, data))
        self.request()

    def _show_picture(self, seen: SentPicture) -> None:
        """Show a picture from the filter thread."""
        self.sender.put(seen)
        if seen.eye is None or seen.kind not in ("full", "failed"):
            return
        notes = seen.facts.get("notes") or [seen.facts.get("error", "")]
        sentences = [f"{n[:1].upper()}{n[1:].rstrip('.')}." for n in notes if n]
        if any("accommodation stops" in note for note in sentences):
            sentences.append(AMPLITUDE)
        self._notes[seen.eye] = " ".join(sentences)
        self._show_notes()
        number, sides = self.state.number, self.state.sides
        if seen.number == number and all(
            self.sender.is_final(side, number) for side in sides
        ):
            self._announcement.cancel()
            result = "full picture." if seen.kind == "full" else "no picture."
            self._status.text = f"{self.state.titles.capitalize()}: {result}"

    def _show_notes(self) -> None:
        notes = {side: self._notes.get(side, "") for side in self.state.sides}
        if len(notes) == 1:
            (self._note.text,) = notes.values()
        else:
            lines = [f"{SIDES[side]}: {text}" for side, text in notes.items() if text]
            self._note.text = "\n".join(lines)

    def close(self) -> None:
        """Release the page's resources."""
        self.header.cancel()
        self._figure_refresh.cancel()
        self._announcement.cancel()
        self.resources.filter_thread.forget(self.name)
        self.resources.figure_worker.forget(self.name)
        self.resources.picture_senders.pop(self.name, None)


def _position(event: events.GenericEventArguments) -> tuple[float, float]:
    """Return a position in the picture, clamped to 0, 0 to 1, 1."""
    x, y = (min(max(float(event.args[name]), 0.0), 1.0) for name in "xy")
    return x, y


def add_page(
    resources: SharedResources, profile: NamedProfile | None, token: str
) -> None:
    """Serve the page at `/`."""

    @ui.page("/", title="ocufilter", response_timeout=RESPONSE_S)
    async def _page(client: Client) -> Response | None:
        # usually available already, because it is rendered when the server starts
        first = asyncio.ensure_future(run.io_bound(scene_picture, SCENES[0]))
        await asyncio.wait({first}, timeout=SCENE_WAIT_S)
        if resources.are_full:  # by requests that waited at the same time
            return HTMLResponse(page_of(FULL), 503)
        page = Page(resources, profile, token)
        client.on_delete(page.close)
        if first.done():
            page.show_default_scene(first)
        try:
            await client.connected(timeout=CONNECT_S)
        except TimeoutError:  # the browser has left
            return None
        with client:
            if not first.done():
                await asyncio.wait({first})
                page.show_default_scene(first)
            await page.start()
        return None

    app.on_shutdown(resources.close)
