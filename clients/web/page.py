"""The page: layout and event handlers."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from nicegui import Client, app, events, run, ui

from clients.report import report_html
from clients.web.chart import row_text
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
from clients.web.scene_file import SceneNotRendered, scene_picture
from clients.web.scene_panel import FIRST, ScenePanel
from clients.web.shared_entries import fragment_of, restore
from clients.web.slider_row import SliderRow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STYLE = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
SHOWN = {"OD": "Right eye", "OS": "Left eye", "both": "Both"}
FIGURES_REST_S = 0.35
"""Time after the last change until figures are redrawn."""

FIRST_ASPECT = 960 / 540
STATUS_REST_S = 0.3
"""Time after which an eye that is being prepared is announced: most are quicker."""

LINK_REST_S = 0.5
"""Time after the last change until the address in the browser is renewed."""

FIRST_S = 1.5
"""Longest time that a page waits for its first scene before it opens without one."""

CONNECT_S = 30.0
READY_S = 120.0
"""Longest time that a download waits for the full picture."""

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
        self,
        resources: SharedResources,
        profile: NamedProfile | None,
    ) -> None:
        self.resources = resources
        self.name = secrets.token_urlsafe(16)
        self.state = PageState()
        if profile is not None:
            self._set_profile(*profile)
        self.out = resources.out[self.name] = PictureSender()
        self._loop = asyncio.get_running_loop()
        self._renewal: asyncio.Task[None] | None = None
        self._linking: asyncio.Task[None] | None = None
        self._announcing: asyncio.Task[None] | None = None
        self._ready: dict[EyeSide, asyncio.Event] = {s: asyncio.Event() for s in SIDES}
        self._fragment = ""
        resources.filter_thread.open(self.name, self._from_thread)
        self._build()

    def _set_profile(self, body: Mapping[str, Any], name: str) -> None:
        for form in self.state.eyes.values():
            form.take_body(body, name)
        self.state.values[AGE.name] = body.get(AGE.name, self.state.values[AGE.name])

    def show_first(self, picture: asyncio.Future[Picture]) -> None:
        """Show the first scene, or why it cannot be rendered."""
        try:
            self._set_picture(picture.result())
        except SceneNotRendered as error:
            self._said.text = str(error)

    async def start(self) -> None:
        """Set the entries of the address's fragment; the browser must be connected."""
        try:
            fragment = await ui.run_javascript("location.hash.slice(1)", timeout=10.0)
        except TimeoutError:  # the browser has left
            return
        if not fragment:
            return
        found = restore(self.state, str(fragment))
        self._show_entries()
        self._said.text = " ".join(found.problems)
        if found.scene is not None and found.scene != FIRST:
            self.scene.choose(found.scene)
        else:
            self.request()

    def _show_entries(self) -> None:
        """Show the state's entries after they were set from a link."""
        for panel in self.panels.values():
            panel.show()
        for name, row in self.rows.items():
            row.show(self.state.values[name])
        self._shown.value = self.state.shown  # shows the eyes, too

    # Layout

    def _build(self) -> None:
        ui.add_css(STYLE)
        ui.colors(primary="#1f5fa8", negative="#b3262e", positive="#2c8a57")
        ui.context.client.content.classes("oc-content")
        with ui.element("header").classes("oc-header"):
            ui.html("ocufilter", tag="h1", sanitize=False).classes("oc-brand")
            ui.label("See through another person’s eyes").classes("oc-motto")
            ui.element("span").classes("oc-grow")
            self._download_buttons()
        with ui.element("div").classes("oc-page"):  # NiceGUI adds the <main>
            with ui.element("div").classes("oc-left"):
                self._eyes_card()
            with ui.element("div").classes("oc-middle"):
                self._picture_card()
                self._sliders_card()
            self.figures = FigurePanel(
                self.name, self.state, self.resources.figure_worker
            )
            with ui.element("div").classes("oc-point"):
                self.figures.build_point()
            with ui.element("div").classes("oc-right"):
                self.figures.build_figure()

    def _download_buttons(self) -> None:
        with ui.element("nav").classes("oc-downloads").props("aria-label=Downloads"):
            for label, tip, act in (
                ("Picture", "What the eye sees, PNG", self._download_picture),
                ("Profile", "The eye's profile, JSON", self._download_profile),
                ("Report", "What this eye sees and why, HTML", self._download_report),
            ):
                ui.button(label, icon="download", on_click=act).props(
                    "outline dense no-caps size=sm"
                ).classes("oc-download").tooltip(tip)
            ui.button("Copy link", icon="link", on_click=self._copy_link).props(
                "outline dense no-caps size=sm"
            ).classes("oc-download").tooltip("Link to these entries, without files")

    def _picture_card(self) -> None:
        with (
            ui.element("section")
            .classes("oc-card oc-picture")
            .props("aria-label=Picture")
        ):
            self.scene = ScenePanel(self.state, self._set_picture, FIRST)
            self.view = PictureView(
                PICTURES_PATH + self.name, list(self.state.sides), FIRST_ASPECT
            )
            self.view.on("point", self._point)
            self.view.on("look", self._look)
            self._status = (
                ui.label("").classes("oc-status").props("role=status aria-live=polite")
            )
            self._note = ui.label("").classes("oc-note").props("aria-live=polite")
            self._said = ui.label("").classes("oc-problem").props("role=alert")
            self._notes: dict[EyeSide, str] = {}

    def _sliders_card(self) -> None:
        values = self.state.values
        with (
            ui.element("section")
            .classes("oc-card oc-sliders")
            .props('aria-label="Viewing conditions"')
        ):
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
        with ui.element("section").classes("oc-card").props("aria-label=Eye"):
            with ui.element("div").classes("oc-line"):
                ui.html("The eye", tag="h2", sanitize=False).classes("oc-title")
                self._copy = ui.button(
                    "copy to the other", on_click=self._copy_eye
                ).props("flat dense no-caps size=sm")
            self._shown = (
                ui.toggle(SHOWN, value=self.state.shown, on_change=self._show)
                .props(
                    'no-caps unelevated spread dense role=group aria-label="Eyes shown"'
                )
                .classes("oc-toggle oc-shown")
            )
            self.panels: dict[EyeSide, EyePanel] = {}
            self._boxes: dict[EyeSide, tuple[ui.element, ui.element]] = {}
            for side, title in SIDES.items():
                with ui.element("div").classes("oc-eye-box") as box:
                    heading = ui.html(title, tag="h3", sanitize=False)
                    heading.classes("oc-eye-title")
                    self.panels[side] = EyePanel(
                        self.state.eyes[side], self.request, self._set_age
                    )
                self._boxes[side] = (box, heading)
            self._show_boxes()
            self._problem = ui.label("").classes("oc-problem").props("role=alert")

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
        self._prepare()
        if self._linking is not None:
            self._linking.cancel()
        self._linking = asyncio.create_task(self._renew_link())
        self.resources.filter_thread.request(self.name, request)
        if self._renewal is not None:
            self._renewal.cancel()
        self._renewal = asyncio.create_task(self._renew_figures())

    def _prepare(self) -> None:
        """Note that the eyes shown are being prepared; announce it if it takes time."""
        for side in self.state.sides:
            self._ready[side].clear()
        titles = " and ".join(SIDES[s].lower() for s in self.state.sides)
        alts = {side: self._alt(side) for side in self.state.sides}
        self.view.describe(alts)
        if self._announcing is not None:
            self._announcing.cancel()
        self._announcing = asyncio.create_task(
            self._announce(
                f"Preparing the {titles}: estimating it and computing its "
                "point-spread functions …"
            )
        )

    async def _announce(self, text: str) -> None:
        await asyncio.sleep(STATUS_REST_S)
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

    async def _renew_link(self) -> None:
        await asyncio.sleep(LINK_REST_S)
        self._linking = None
        self._write_link()

    def _write_link(self) -> None:
        """Write the entries to the browser's address, for reloads and links."""
        if self.view.is_deleted:  # an upload may end after its page was closed
            return
        fragment = fragment_of(self.state, self.scene.kind)
        if fragment != self._fragment:
            self._fragment = fragment
            with self.view:
                ui.run_javascript(f'history.replaceState(null, "", "#{fragment}")')

    def _copy_link(self) -> None:
        self._write_link()
        ui.run_javascript("navigator.clipboard.writeText(location.href)")
        ui.notify("Link copied; it has no uploaded files", position="top", timeout=3000)

    async def _renew_figures(self) -> None:
        await asyncio.sleep(FIGURES_REST_S)
        self._renewal = None  # from here on it is not canceled: newer ones wait
        await self.figures.renew()
        await self._mark_rows()

    async def _mark_rows(self) -> None:
        """Label the rows of a chart, and the smallest one that each eye reads."""
        picture = self.state.picture
        rows = picture.chart_rows if picture is not None else ()
        read = await self.figures.smallest_rows() if rows else {}
        if read is None or self.state.picture is None:
            return
        if self.state.picture.chart_rows != rows:
            return
        self.view.mark_rows(
            [
                {"y": y, "text": row_text(log_mar), "eyes": read.get(k, [])}
                for k, (log_mar, y) in enumerate(rows)
            ]
        )

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
        self.view.show_scene(picture.title, picture.aspect_ratio)
        self.view.mark_rows([])
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
        ui.notify(
            f"{SIDES[other]}: as the {SIDES[side].lower()}",
            position="top",
            timeout=2000,
        )

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
            if seen.number == self.state.number:
                self._finish(seen.eye, is_full=seen.kind == "full")

    def _finish(self, side: EyeSide, *, is_full: bool) -> None:
        """Note that an eye's full picture is shown, or could not be made."""
        self._ready[side].set()
        if not all(self._ready[s].is_set() for s in self.state.sides):
            return
        if self._announcing is not None:
            self._announcing.cancel()
        titles = " and ".join(SIDES[s].lower() for s in self.state.sides).capitalize()
        self._status.text = f"{titles}: " + (
            "full picture." if is_full else "no picture."
        )

    def _show_notes(self) -> None:
        lines = [(SIDES[side], self._notes.get(side)) for side in self.state.sides]
        if len(lines) == 1:
            self._note.text = lines[0][1] or ""
        else:
            told = [f"{title}: {text}" for title, text in lines if text]
            self._note.text = "\n".join(told)

    # Downloads

    async def _download_picture(self) -> None:
        sides = self.state.sides
        for side in sides:  # a click while the eye is prepared waits for it
            try:
                await asyncio.wait_for(self._ready[side].wait(), READY_S)
            except TimeoutError:
                ui.notify(
                    "The full picture is not ready yet", type="warning", position="top"
                )
                return
        for side in sides:
            seen = self._full(side)
            if seen is not None:
                ui.download(seen.data, f"ocufilter_{side}.png")

    async def _download_report(self) -> None:
        for side in self.state.sides:
            body = self.state.body_at_gaze(side)
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
                text = await self.resources.figure_worker.ask(
                    self.name, f"report {side}", report_html, body, label=title
                )
            except StudyFailed as error:
                ui.notify(str(error), type="negative", position="top")
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
                ui.notify(str(error), type="negative", position="top")
                return
            ui.download(text.encode(), f"ocufilter_{side}.json")

    def close(self) -> None:
        """Release the page's resources."""
        for task in (self._renewal, self._linking, self._announcing):
            if task is not None:
                task.cancel()
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
        # rendered while the server started, so that the page usually opens with it
        first = asyncio.ensure_future(run.io_bound(scene_picture, FIRST))
        await asyncio.wait({first}, timeout=FIRST_S)
        page = Page(resources, profile)
        client.on_delete(page.close)
        if first.done():
            page.show_first(first)
        try:
            await client.connected(timeout=CONNECT_S)
        except TimeoutError:  # the browser has left
            return
        with client:
            if not first.done():
                await asyncio.wait({first})
                page.show_first(first)
            await page.start()

    app.on_shutdown(resources.close)
