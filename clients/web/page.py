"""The page: layout and event handlers."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fastapi import Response
from fastapi.responses import HTMLResponse
from nicegui import Client, app, events, run, ui

from clients.web.bounds import FULL, MAX_PAGES
from clients.web.chart import caption, marks_of
from clients.web.downloads import Downloads
from clients.web.eye_form import SIDES, EyeSide
from clients.web.eye_panel import EyePanel
from clients.web.figure_panel import FigurePanel
from clients.web.figure_worker import FigureWorker
from clients.web.filter_thread import FilterThread
from clients.web.guard import page_of
from clients.web.numbers import NumberField, distance_text
from clients.web.page_link import PageLink
from clients.web.page_state import AGE, CONDITIONS, DISTANCE, FOCUS, PUPIL, PageState
from clients.web.picture import Picture
from clients.web.picture_files import png_of
from clients.web.picture_requests import SentPicture
from clients.web.picture_sender import PictureSender
from clients.web.picture_view import PictureView
from clients.web.scene_file import SceneNotRendered, scene_picture
from clients.web.scene_panel import DEFAULT_SCENE, ScenePanel
from clients.web.shared_entries import SCENES, restore
from clients.web.slider_row import SliderRow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

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
    "The amplitude is that of objective accommodation; a push-up measurement also "
    "includes the depth of focus and reads higher."
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
            self._set_profile(*profile)
        self.sender = resources.picture_senders[self.name] = PictureSender()
        self._loop = asyncio.get_running_loop()
        self._figure_refresh: asyncio.Task[None] | None = None
        self._announcement: asyncio.Task[None] | None = None
        self._ready: dict[EyeSide, asyncio.Event] = {s: asyncio.Event() for s in SIDES}
        self._empty_reason = ""
        resources.filter_thread.open(self.name, self._from_thread)
        self.downloads = Downloads(
            self.name,
            self.state,
            self.sender,
            resources.figure_worker,
            ready=self._ready,
            empty_reason=lambda: self._empty_reason,
        )
        self._build()
        self.link = PageLink(
            self.state,
            token,
            scene=lambda: self.scene.kind,
            on_fragment=self._restore,
            element=self.view,
        )

    def _set_profile(self, body: Mapping[str, Any], name: str) -> None:
        for form in self.state.eyes.values():
            form.load_body(body, name)
        self.state.values[AGE.name] = body.get(AGE.name, self.state.values[AGE.name])

    def show_default_scene(self, picture: asyncio.Future[Picture]) -> None:
        """Show the default scene, or the reason that it cannot be rendered."""
        try:
            self._set_picture(picture.result())
        except SceneNotRendered as error:
            self._scene_problem.text = str(error)

    async def start(self) -> None:
        """Restore the entries from the address; the browser must be connected."""
        fragment = await self.link.read()
        if fragment:
            self._restore(fragment)
        else:
            self.link.schedule_update()

    def _restore(self, fragment: str) -> None:
        """Restore the entries from a fragment of the address."""
        found = restore(self.state, fragment)
        self._show_entries()
        self._scene_problem.text = " ".join(found.problems)
        scene = found.scene if found.scene in SCENES else None
        # links never contain a photo: keep it unless the link selects another scene
        if scene == DEFAULT_SCENE and self.scene.kind not in SCENES:
            scene = None
        if scene is not None and scene != self.scene.kind:
            self.scene.choose(scene)
        else:
            self.request()

    def _show_entries(self) -> None:
        """Show the state's entries after they were set from a link."""
        for panel in self.panels.values():
            panel.show()
        self._show_values()
        self._pipelines.value = self.state.pipeline
        self._shown.value = self.state.shown  # shows the eyes, too

    def _show_values(self) -> None:
        for name, row in self.rows.items():
            row.show(self.state.values[name])

    # Layout

    def _build(self) -> None:
        ui.add_css(STYLE)
        ui.colors(primary="#1f5fa8", negative="#b3262e", positive="#2c8a57")
        ui.context.client.content.classes("oc-content")
        with ui.element("header").classes("oc-header"):
            ui.html("ocufilter", tag="h1", sanitize=False).classes("oc-brand")
            ui.label("See through another person’s eyes").classes("oc-motto")
            ui.element("span").classes("oc-grow")
            self.downloads.build(lambda: self.link.copy())
        self.rows: dict[str, SliderRow] = {}
        self.figures = FigurePanel(self.name, self.state, self.resources.figure_worker)
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
        with (
            ui.element("section")
            .classes("oc-card oc-picture")
            .props("aria-label=Picture")
        ):
            self.scene = ScenePanel(
                self.state, self._set_picture, self._set_empty, DEFAULT_SCENE
            )
            self.view = PictureView(
                PICTURES_PATH + self.name, list(self.state.sides), DEFAULT_ASPECT
            )
            self.view.on("point", self._point)
            self.view.on("look", self._focus)
            self._status = (
                ui.label("").classes("oc-status").props("role=status aria-live=polite")
            )
            self._note = ui.label("").classes("oc-note").props("aria-live=polite")
            self._scene_problem = ui.label("").classes("oc-problem").props("role=alert")
            self._notes: dict[EyeSide, str] = {}

    def _sliders_card(self) -> None:
        with (
            ui.element("section")
            .classes("oc-card oc-sliders")
            .props('aria-label="Viewing conditions"')
        ):
            for number in CONDITIONS:
                if number is not AGE:
                    self._slider(number)
            with (
                ui.element("div").classes("oc-look").props("role=group aria-label=Look")
            ):
                ui.label("Look").props("aria-hidden=true")
                for label, is_reading in (("Far", False), ("Reading", True)):
                    ui.button(
                        label, on_click=lambda _, near=is_reading: self._look(near)
                    ).props("outline dense no-caps size=sm").classes("oc-download")
                ui.element("span").classes("oc-grow")
                self._pipelines = (
                    ui.toggle(
                        PIPELINES,
                        value=self.state.pipeline,
                        on_change=self._choose_pipeline,
                    )
                    .props(
                        "no-caps unelevated dense size=sm role=group aria-label=Method"
                    )
                    .classes("oc-toggle")
                )

    def _slider(self, number: NumberField) -> None:
        name = number.name
        self.rows[name] = SliderRow(
            number,
            self.state.values[name],
            lambda value: self._slide(name, value),
            format_value=distance_text if number in (FOCUS, DISTANCE) else None,
        )

    def _eyes_card(self) -> None:
        with ui.element("section").classes("oc-card").props("aria-label=Eye"):
            with ui.element("div").classes("oc-line"):
                ui.html("The eye", tag="h2", sanitize=False).classes("oc-title")
                self._copy = ui.button(
                    "Copy to the other eye", on_click=self._copy_eye
                ).props("flat dense no-caps size=sm")
            self._shown = (
                ui.toggle(SHOWN, value=self.state.shown, on_change=self._show)
                .props(
                    'no-caps unelevated spread dense role=group aria-label="Eyes shown"'
                )
                .classes("oc-toggle oc-shown")
            )
            self._slider(AGE)
            self.panels: dict[EyeSide, EyePanel] = {}
            self._boxes: dict[EyeSide, tuple[ui.element, ui.element]] = {}
            for side, title in SIDES.items():
                with ui.element("div").classes("oc-eye-box") as box:
                    heading = ui.html(title, tag="h3", sanitize=False)
                    heading.classes("oc-eye-title")
                    self.panels[side] = EyePanel(
                        self.state.eyes[side], self._change_eye, self._take_file
                    )
                self._boxes[side] = (box, heading)
            self._show_boxes()
            self._problem = ui.label("").classes("oc-problem").props("role=alert")

    # Event handlers

    def _change_eye(self) -> None:
        """Request a picture if a profile has changed; report invalid entries."""
        if self.state.read_profiles():
            self.request()
        else:
            self._report_problems()
            self.link.schedule_update()

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
        self._prepare()
        self.link.schedule_update()
        self.resources.filter_thread.request(self.name, request)
        if self._figure_refresh is not None:
            self._figure_refresh.cancel()
        self._figure_refresh = asyncio.create_task(self._refresh_figures())

    def _prepare(self) -> None:
        """Mark the eyes shown as being prepared; announce it after a delay."""
        for side in self.state.sides:
            self._ready[side].clear()
        titles = " and ".join(SIDES[s].lower() for s in self.state.sides)
        alts = {side: self._alt(side) for side in self.state.sides}
        self.view.describe(alts)
        if self._announcement is not None:
            self._announcement.cancel()
        self._announcement = asyncio.create_task(
            self._announce(
                f"Preparing the {titles}: estimating the eye model and computing "
                "point-spread functions…"
            )
        )

    async def _announce(self, text: str) -> None:
        await asyncio.sleep(STATUS_DELAY_S)
        self._status.text = text

    def _alt(self, side: EyeSide) -> str:
        """Return the text alternative of an eye's picture."""
        values, picture = self.state.values, self.state.picture
        title = picture.title if picture is not None else "scene"
        return (
            f"{title} as the {SIDES[side].lower()} sees it through a pupil of "
            f"{values[PUPIL.name]:.1f} mm, focused at "
            f"{distance_text(values[FOCUS.name])}"
        )

    async def _refresh_figures(self) -> None:
        await asyncio.sleep(FIGURES_DELAY_S)
        self._figure_refresh = None  # not canceled from here on: newer refreshes wait
        await self._mark_rows()
        await self.figures.refresh()

    async def _mark_rows(self) -> None:
        """Label the rows of a chart; mark the smallest one that each eye can read."""
        picture = self.state.picture
        rows = picture.chart_rows if picture is not None else ()
        read = await self.figures.smallest_rows() if rows else {}
        if read is None or self.state.picture is None:
            return
        if self.state.picture.chart_rows != rows:
            return
        captions = {side: caption(rows, smallest) for side, smallest in read.items()}
        self.view.mark_rows(marks_of(rows, cast("Mapping[str, Any]", read)), captions)

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
        self.rows[AGE.name].show(self.state.values[AGE.name])
        for panel in self.panels.values():
            panel.show()
        if loaded_side == side:
            self.request()
            return
        ui.notify(
            f"{name} is a profile of the {SIDES[loaded_side].lower()} and "
            "was loaded there",
            position="top",
            timeout=6000,
        )
        if self.state.shown == "both":
            self.request()
        else:
            self._shown.value = loaded_side  # requests it

    def _set_empty(self, text: str) -> None:
        """Show a text in place of the picture."""
        self._empty_reason = text
        self.view.show_empty(text)
        self._status.set_visibility(not text)
        self._note.set_visibility(not text)

    def _set_picture(self, picture: Picture) -> None:
        self.state.set_picture(picture)
        for name in (PUPIL.name, FOCUS.name, DISTANCE.name):
            self.rows[name].show(self.state.values[name])
        self.rows[DISTANCE.name].enable(
            picture.distance_dpt is not None, "as in the picture"
        )
        self._set_empty("")
        self.view.show_scene(picture.title, picture.aspect_ratio)
        self.view.mark_rows(marks_of(picture.chart_rows, {}), {})
        number = self.state.number + 1
        self.sender.put(
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
        self.rows[FOCUS.name].show(self.state.values[FOCUS.name])
        self.request()

    # Pictures from the filter thread

    def _from_thread(self, seen: SentPicture) -> None:
        self._loop.call_soon_threadsafe(self._show_picture, seen)

    def _show_picture(self, seen: SentPicture) -> None:
        self.sender.put(seen)
        if seen.kind in ("full", "failed"):
            assert seen.eye is not None
            notes = seen.facts.get("notes") or [seen.facts.get("error", "")]
            sentences = [_sentence(note) for note in notes if note]
            if any("accommodation stops" in note for note in sentences):
                sentences.append(AMPLITUDE)
            self._notes[seen.eye] = " ".join(sentences)
            self._show_notes()
            if seen.number == self.state.number:
                self._finish(seen.eye, is_full=seen.kind == "full")

    def _finish(self, side: EyeSide, *, is_full: bool) -> None:
        """Record that an eye's full picture is shown or has failed."""
        self._ready[side].set()
        if not all(self._ready[s].is_set() for s in self.state.sides):
            return
        if self._announcement is not None:
            self._announcement.cancel()
        titles = " and ".join(SIDES[s].lower() for s in self.state.sides).capitalize()
        self._status.text = f"{titles}: " + (
            "full picture." if is_full else "no picture."
        )

    def _show_notes(self) -> None:
        lines = [(SIDES[side], self._notes.get(side)) for side in self.state.sides]
        if len(lines) == 1:
            self._note.text = lines[0][1] or ""
        else:
            notes = [f"{title}: {text}" for title, text in lines if text]
            self._note.text = "\n".join(notes)

    def close(self) -> None:
        """Release the page's resources."""
        self.link.close()
        for task in (self._figure_refresh, self._announcement):
            if task is not None:
                task.cancel()
        self.resources.filter_thread.forget(self.name)
        self.resources.figure_worker.forget(self.name)
        self.resources.picture_senders.pop(self.name, None)


def _position(event: events.GenericEventArguments) -> tuple[float, float]:
    """Return a position in the picture, clamped to 0, 0 to 1, 1."""
    x, y = (min(max(float(event.args[name]), 0.0), 1.0) for name in "xy")
    return x, y


def _sentence(note: str) -> str:
    return note[:1].upper() + note[1:].rstrip(".") + "."


def add_page(
    resources: SharedResources, profile: NamedProfile | None, token: str
) -> None:
    """Serve the page at `/`."""

    @ui.page("/", title="ocufilter", response_timeout=RESPONSE_S)
    async def _page(client: Client) -> Response | None:
        # usually available already, because it is rendered when the server starts
        first = asyncio.ensure_future(run.io_bound(scene_picture, DEFAULT_SCENE))
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
