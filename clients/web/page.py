"""The page: layout and event handlers."""

from __future__ import annotations

import asyncio
import math
import secrets
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Response
from fastapi.responses import HTMLResponse
from nicegui import Client, app, background_tasks, events, run, ui

from clients.scenes.letter_chart import smallest_row
from clients.web.comparison import EYE_NAMES, EyeName, side_of
from clients.web.controls import (
    AGE,
    DISTANCE,
    DISTANCES_M,
    FOCUS,
    GAZE_H,
    GAZE_V,
    LIGHTS,
    PUPIL,
    SCENE_LIGHTS,
    NumberField,
    distance_text,
)
from clients.web.eye_form import SIDES
from clients.web.eyes_card import EyesCard
from clients.web.figure_panel import FigurePanel
from clients.web.figure_worker import FigureWorker
from clients.web.filter_thread import FilterThread, SentPicture
from clients.web.guard import FULL, MAX_PAGES, page_of
from clients.web.header import Header
from clients.web.page_link import restore
from clients.web.page_state import SCENES, PageState
from clients.web.page_texts import (
    CONDITIONS_HELP,
    HAZE_OFFER,
    NORMAL,
    NOT_MEDICAL,
    PICTURE_HELP,
)
from clients.web.picture import Picture, SceneNotRendered, png_of, scene_picture
from clients.web.picture_panel import PictureSender, PictureView, ScenePanel
from clients.web.scenario_menu import ScenarioMenu
from clients.web.sight import eye_sentences
from clients.web.widgets import (
    Delayed,
    SliderRow,
    card,
    help_button,
    more,
    problem_label,
    select,
    small_button,
    toggle,
)

STYLE = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
ARRANGEMENTS = {"divider": "One divider", "beside": "Side by side"}
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
        self._notes: dict[EyeName, list[str]] = {}
        self._sights: dict[EyeName, dict[str, Any]] = {}
        self._rows_read: dict[EyeName, int | None] = {}
        self.rows: dict[str, SliderRow] = {}
        loop = asyncio.get_running_loop()
        resources.filter_thread.open(
            self.name,
            lambda seen: loop.call_soon_threadsafe(self._show_picture, seen),
        )
        self._build(token)

    # Layout

    def _build(self, token: str) -> None:
        state = self.state
        ui.add_css(STYLE)
        ui.colors(primary="#1f5fa8", negative="#b3262e", positive="#2c8a57")
        ui.context.client.content.classes("oc-content")
        ask = partial(self.resources.figure_worker.ask, self.name)
        self.header = Header(
            *(state, self.sender, ask, token),
            scene=lambda: self.scene.kind,
            on_fragment=self._restore,
        )
        self.figures = FigurePanel(state, ask)
        with ui.element("div").classes("oc-page"):  # NiceGUI adds the <main>
            with ui.element("div").classes("oc-columns"):
                with ui.element("div").classes("oc-left"):
                    self.eyes = EyesCard(
                        *(state, self._slider),
                        on_shown=self._show_eyes,
                        on_change=self._change_eye,
                        on_file=self._take_file,
                    )
                    self.figures.build_point()
                with ui.element("div").classes("oc-middle"):
                    self._picture_card()
                    self._sliders_card()
                    ui.label(NORMAL).classes("oc-hint oc-told")
                    with ui.element("div").classes("oc-results"):
                        self.figures.build_figure()
            self._show_views()
            ui.label(NOT_MEDICAL).classes("oc-hint oc-disclaimer")

    def _picture_card(self) -> None:
        state = self.state
        with card("Picture", "oc-picture"):
            with ui.element("div").classes("oc-scene-line"):
                self.scene = ScenePanel(
                    *(state, self._set_picture, self._set_empty),
                    on_notation=self._mark_rows,
                    on_distance=self._set_distance,
                )
                self.scenarios = ScenarioMenu(state, self._start_scenario)
            self.scene.build_uploads()
            self.view = PictureView(PICTURES_PATH + self.name, DEFAULT_ASPECT)
            self.view.on("point", self._point)
            self.view.on("look", self._focus)
            with self.view:
                self._arrangement = toggle(
                    *(ARRANGEMENTS, state.arrangement, self._arrange),
                    label="Arrangement of A and B",
                    props="size=sm",
                    kind="oc-arrangement",
                )
                self._status = ui.label("").classes("oc-status")
                self._status.props("role=status aria-live=polite")
                help_button("the picture", PICTURE_HELP)
            with self.view.add_slot("told"):
                self._note = ui.label("").classes("oc-note oc-sight")
                self._note.props("aria-live=polite")
            with ui.element("div").classes("oc-sentences"):
                self.scenarios.build_text()
                self.eyes.build_differences()
                with ui.element("div").classes("oc-look-group") as self._haze_offer:
                    ui.label(HAZE_OFFER).classes("oc-hint")
                    small_button("Add straylight of this age", self._add_haze)
            self._scene_problem = problem_label()

    def _sliders_card(self) -> None:
        with card("Viewing conditions", "oc-sliders"):
            for number in (PUPIL, FOCUS, DISTANCE, GAZE_H, GAZE_V):
                self._slider(number)
            self._light = select(
                {name: text for name, (text, _) in LIGHTS.items()},
                self.state.light,
                self._set_light,
                label="Light",
            ).classes("oc-light")
            with ui.element("div").classes("oc-look"):
                with ui.element("div").classes("oc-look-group") as group:
                    group.props("role=group aria-label=Look")
                    ui.label("Look").props("aria-hidden=true")
                    for label, is_reading in (("Far", False), ("Reading", True)):
                        small_button(label, partial(self._look, is_reading))
                with ui.element("div").classes("oc-look-group") as group:
                    group.props('role=group aria-label="Look at a distance"')
                    ui.label("Look at").props("aria-hidden=true")
                    for label, meters in DISTANCES_M.items():
                        small_button(label, partial(self._look_at, meters))
                ui.element("span").classes("oc-grow")
                with more():
                    self._pipelines = toggle(
                        *(PIPELINES, self.state.pipeline, self._choose_pipeline),
                        label="Method",
                        props="size=sm",
                    )
                help_button("viewing conditions", CONDITIONS_HELP)

    def _slider(self, number: NumberField) -> SliderRow:
        value = self.state.values[number.name]
        self.rows[number.name] = SliderRow(number, value, self._slide)
        return self.rows[number.name]

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
        self.scenarios.clear()
        self._show_entries()
        self._show_views()
        self._scene_problem.text = " ".join(found.problems)
        # links never contain a photo: keep it unless the link selects another scene
        keeps_file = found.scene == SCENES[0] and self.scene.kind not in SCENES
        if found.scene in (None, self.scene.kind) or keeps_file:
            self.request()
        else:
            self.state.keeps_focus = True
            self.scene.choose(found.scene)

    def _start_scenario(self, scene: str) -> None:
        """Show the entries of a scenario, and its scene."""
        self._show_entries()
        self._show_views()
        if self.scene.kind == scene:
            self.request()
        else:
            self.state.keeps_focus = True
            self.scene.choose(scene)

    def _show_values(self) -> None:
        for name, row in self.rows.items():
            row.show(self.state.values[name])
        self._light.value = self.state.light

    def _show_entries(self) -> None:
        """Show all entries after changes that were not made in the panels."""
        self.eyes.refresh()
        self._show_values()
        self._pipelines.value = self.state.pipeline
        self._arrangement.value = self.state.arrangement
        self.scene.show_notation()

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
        self.eyes.problem.text = "\n".join(problems)

    def request(self) -> None:
        """Request a picture for the current entries; report invalid entries."""
        request = self.state.request()
        self._report_problems()
        self.eyes.show_differences()
        self.scenarios.show_changes(self.scene.kind)
        self._show_haze_offer()
        if request is None:
            return
        self._forget_figures()
        self.view.show(alts={name: self._alt(name) for name in self.state.names})
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

    def _alt(self, name: EyeName) -> str:
        """Return the text alternative of an eye's picture."""
        values, picture = self.state.values, self.state.picture
        scene = picture.title if picture is not None else "scene"
        eye = SIDES[side_of(name)].lower()
        if self.state.is_comparing:
            eye += f" in state {self.state.title(name)}"
        return (
            f"{scene} as the {eye} sees it through a pupil of "
            f"{values[PUPIL.name]:.1f} mm, focused at "
            f"{distance_text(values[FOCUS.name])}"
        )

    def _forget_figures(self) -> None:
        """Hide sentences and figures of former entries until those of these are known.

        The rows of a chart lose their marks, and points of light are shown as outdated.
        """
        self._notes, self._sights = {}, {}
        self._show_notes()
        self.figures.mark_outdated()
        if self._rows_read:
            self._rows_read = {}
            self._mark_rows()

    async def _refresh_figures(self) -> None:
        number = self.state.number
        found = await self.figures.sights()
        picture = self.state.picture
        if found is not None and picture is not None and number == self.state.number:
            self._sights = found
            self._show_notes()
            # label the rows of a chart; mark the smallest one that each eye can read
            rows = [row.log_mar for row in picture.chart_rows]
            self._rows_read = {
                name: smallest_row(rows, sight["log_mar"])
                for name, sight in found.items()
                if rows and not math.isnan(sight["log_mar"])
            }
            if rows:
                self._mark_rows()
        await self.figures.refresh()

    def _mark_rows(self) -> None:
        """Label the rows of a chart, and name acuities, in the chosen notation."""
        self._show_notes()
        if self.state.picture is not None:
            notation = self.state.notation
            self.view.mark_rows(self.state.picture, self._rows_read, notation)
        self.header.schedule_update()

    def _slide(self, name: str, value: float) -> None:
        self.state.move(name, value)
        moved = {DISTANCE.name: FOCUS, AGE.name: PUPIL}.get(name)
        if moved is not None:
            self.rows[moved.name].show(self.state.values[moved.name])
        self._light.value = self.state.light
        self.request()

    def _set_light(self, event: events.ValueChangeEventArguments) -> None:
        if event.value != self.state.light:
            self.state.set_light(event.value)
            self._show_values()
            self.request()

    def _show_haze_offer(self) -> None:
        forms = [self.state.form(name) for name in self.state.names]
        lacks_haze = any(form.haze == "none" for form in forms)
        is_night = self.scene.kind in SCENE_LIGHTS
        self._haze_offer.set_visibility(is_night and lacks_haze)

    def _add_haze(self) -> None:
        for name in self.state.names:
            if self.state.form(name).haze == "none":
                self.state.form(name).haze = "age"
        self.eyes.refresh()
        self.request()

    def _set_distance(self, meters: float) -> None:
        self.state.move(DISTANCE.name, round(1.0 / meters, 4))
        self._show_values()
        self.request()

    def _look_at(self, meters: float) -> None:
        self.state.look_at_distance(meters)
        self._show_values()
        self.request()

    def _look(self, is_reading: bool) -> None:
        self.state.look(is_reading=is_reading)
        self._show_values()
        self.request()

    def _choose_pipeline(self, event: events.ValueChangeEventArguments) -> None:
        self.state.pipeline = event.value
        self.request()

    async def _take_file(self, eye: EyeName, name: str, content: bytes) -> None:
        loaded = self.state.load_file(eye, name, content)
        self._show_entries()
        if loaded != eye:
            ui.notify(
                f"{name} is a profile of the {SIDES[side_of(loaded)].lower()} and "
                "was loaded there",
                position="top",
                timeout=6000,
            )
        if loaded in (eye, *self.state.names):
            self.request()
        else:
            self.eyes.show_eye(loaded)  # requests it

    def _show_eyes(self) -> None:
        """Show other eyes or states."""
        self._show_values()
        self._show_views()
        self.request()

    def _show_views(self) -> None:
        """Show the pictures of the selected eyes or states, and their entries."""
        state = self.state
        self.view.show(
            eyes=list(state.names),
            labels_of={name: state.title(name) for name in state.names},
            behind_one=state.is_comparing and state.arrangement == "divider",
            whole=state.is_comparing and state.arrangement == "beside",
        )
        self._arrangement.set_visibility(state.is_comparing)
        self._show_notes()

    def _arrange(self, event: events.ValueChangeEventArguments) -> None:
        self.state.arrangement = event.value
        self._show_views()
        self.header.schedule_update()

    async def _point(self, event: events.GenericEventArguments) -> None:
        if event.args["eye"] in EYE_NAMES:
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
        self.state.adapt_to(self.scene.kind)
        self.state.set_picture(picture)
        self._show_values()
        self.rows[DISTANCE.name].enable(
            picture.distance_dpt is not None, "as in the picture"
        )
        self._set_empty("")
        aspect = picture.view.width_px / picture.view.height_px
        self.view.show(scene=picture.title, aspect=aspect)
        self._rows_read = {}
        self._mark_rows()
        number, data = self.state.number + 1, png_of(picture.view.color)
        self.sender.put(SentPicture("scene", None, number, data))
        self.request()

    def _show_picture(self, seen: SentPicture) -> None:
        """Show a picture from the filter thread."""
        self.sender.put(seen)
        if seen.eye is None or seen.kind not in ("full", "failed"):
            return
        number, names = self.state.number, self.state.names
        if seen.number != number:
            return
        notes = seen.facts.get("notes") or [seen.facts.get("error", "")]
        self._notes[seen.eye] = [note for note in notes if note]
        self._show_notes()
        if all(self.sender.is_final(name, number) for name in names):
            self._announcement.cancel()
            result = "full picture." if seen.kind == "full" else "no picture."
            titles = self.state.titles
            self._status.text = f"{titles[:1].upper()}{titles[1:]}: {result}"

    def _sentences(self, name: EyeName) -> str:
        return eye_sentences(
            self._sights.get(name),
            self._notes.get(name, ()),
            self.state.valid_profiles.get(name, {}),
            object_dpt=self.state.object_dpt,
            notation=self.state.notation,
        )

    def _show_notes(self) -> None:
        notes = {name: self._sentences(name) for name in self.state.names}
        if len(notes) == 1:
            (self._note.text,) = notes.values()
        else:
            lines = [
                f"{self.state.title(name)}: {text}"
                for name, text in notes.items()
                if text
            ]
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
