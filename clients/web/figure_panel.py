"""Side panel: the point under the pointer, and figures of the eye."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.scenes.letter_chart import smallest_row
from clients.web.eye_figures import FIGURE_TITLES, eye_figure, predicted_log_mar
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import FigureFailed, FigureWorker
from clients.web.numbers import distance_text
from clients.web.page_state import DISTANCE, FOCUS, PUPIL, PageState
from clients.web.point_spread import PointState, point_spread

WIDTHS_ARCMIN = {
    "a stroke of the 1.0 (20/20) line": 1.0,
    "a letter of the 1.0 (20/20) line": 5.0,
    "a letter of the 0.5 (20/40) line": 10.0,
    "the full moon": 31.0,
    "a little finger at arm's length": 60.0,
    "a thumb at arm's length": 120.0,
    "three fingers at arm's length": 300.0,
    "a fist at arm's length": 600.0,
}
"""Visual angles of familiar objects."""


def data_url(png: bytes) -> str:
    """Return a picture as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


class FigurePanel:
    """Point-spread function and figures of one eye.

    Parameters
    ----------
    page : str
        Page that owns the requests.
    """

    def __init__(
        self, page: str, state: PageState, figure_worker: FigureWorker
    ) -> None:
        self._page, self._state, self._worker = page, state, figure_worker
        self._side: EyeSide = "OD"
        self._at = (0.5, 0.5)
        self._figure = next(iter(FIGURE_TITLES))
        self._drawn_request: Any = None
        self._enlarged = ui.dialog().props('aria-label="Figure"')
        with self._enlarged, ui.card().classes("oc-enlarged"):
            self._large = ui.html("", sanitize=False)
            ui.button("Close", on_click=self._enlarged.close).props("flat no-caps")

    def build_point(self) -> None:
        """Build the point-spread function card."""
        with (
            ui.element("section")
            .classes("oc-card oc-point")
            .props("aria-label='Point of light'")
        ):
            ui.html(
                "How a point of light looks here", tag="h2", sanitize=False
            ).classes("oc-title")
            self._psf = self._picture_button("oc-psf", "the point of light")
            self._message_label = ui.label(
                "Move the pointer over the picture."
            ).classes("oc-hint")

    def build_figure(self) -> None:
        """Build the figure card."""
        with ui.element("section").classes("oc-card").props("aria-label=Figures"):
            self._title = ui.html("Figures", tag="h2", sanitize=False).classes(
                "oc-title"
            )
            ui.toggle(FIGURE_TITLES, value=self._figure, on_change=self._choose).props(
                "no-caps unelevated spread dense role=group aria-label=Figure"
            ).classes("oc-toggle oc-figures")
            self._image = self._picture_button("oc-figure", "the figure")

    def _picture_button(self, kind: str, what: str) -> ui.html:
        """Create a placeholder for an image that opens enlarged when clicked."""
        with ui.element("div").classes(kind):
            with ui.element("button").classes("oc-enlarge") as button:
                button.props(f'type=button aria-label="Enlarge {what}"')
                image_slot = ui.html("", sanitize=False)
            ui.label("Computing…").classes("oc-hint oc-computing")
        button.on("click", lambda: self._enlarge(image_slot))
        return image_slot

    def _enlarge(self, image_slot: ui.html) -> None:
        if image_slot.content:
            self._large.content = image_slot.content
            self._enlarged.open()

    async def point(self, side: EyeSide, x: float, y: float) -> None:
        """Show the point-spread function at a position in the picture."""
        self._side, self._at = side, (x, y)
        await self._show_point()

    async def refresh(self) -> None:
        """Redraw everything after a change of the eye or its state."""
        if self._side not in self._state.sides:
            self._side = self._state.sides[0]
        await self._show_point()
        await self._show_figure()

    async def _choose(self, event: events.ValueChangeEventArguments) -> None:
        self._figure = event.value
        await self._show_figure()

    async def _ask(
        self, kind: str, function: Callable[..., Any], *args: Any, **options: Any
    ) -> Any:
        """Run a function in the worker.

        Return None if it fails or a newer request supersedes it.
        """
        try:
            return await self._worker.ask(self._page, kind, function, *args, **options)
        except FigureFailed as error:
            self._message_label.text = str(error)
            return None

    def _body(self) -> str | None:
        body = self._state.profile_at_gaze(self._side)
        return None if body is None else json.dumps(body, sort_keys=True)

    async def _show_point(self) -> None:
        body = self._body()
        scene_point = self._state.scene_point(*self._at)
        if body is None or scene_point is None:
            return
        values = self._state.values
        point = PointState(
            direction_deg=scene_point.direction_deg(self._state.picture_gaze_deg),
            object_dpt=scene_point.distance_dpt,
            pupil_diameter_mm=values[PUPIL.name],
            focus_dpt=values[FOCUS.name],
        )
        answer = await self._ask("point", point_spread, body, point)
        if answer is None:
            return
        png, facts = answer
        self._psf.content = (
            f'<img src="{data_url(png)}" alt="Image of the point of light">'
        )
        self._message_label.text = describe_point(facts)

    async def smallest_rows(self) -> dict[EyeSide, int | None] | None:
        """Return the smallest chart row that each eye can read; None if it reads none.

        Return None if a request failed or was superseded.  An eye whose acuity is
        unknown is omitted.
        """
        picture, values = self._state.picture, self._state.values
        rows = [row.log_mar for row in picture.chart_rows] if picture else []
        found: dict[EyeSide, int | None] = {}
        for side in self._state.sides if rows else ():
            body = self._state.profile_at_gaze(side)
            if body is None:
                continue
            log_mar = await self._ask(
                f"acuity {side}",
                predicted_log_mar,
                json.dumps(body, sort_keys=True),
                pupil_diameter_mm=values[PUPIL.name],
                focus_dpt=values[FOCUS.name],
                object_dpt=values[DISTANCE.name],
            )
            if log_mar is None:
                return None
            if not math.isnan(log_mar):
                found[side] = smallest_row(rows, log_mar)
        return found

    async def _show_figure(self) -> None:
        self._title.content = f"Figures: {SIDES[self._side].lower()}"
        body, values = self._body(), self._state.values
        state = {name: values[name] for name in (PUPIL.name, FOCUS.name)}
        request = (
            self._figure,
            body,
            *(state.values() if self._depends_on_eye_state else ()),
        )
        if body is None or request == self._drawn_request:
            return
        png = await self._ask("figure", eye_figure, self._figure, body, **state)
        if png is not None:
            self._drawn_request = request
            title = FIGURE_TITLES[self._figure]
            self._image.content = f'<img src="{data_url(png)}" alt="{title}">'

    @property
    def _depends_on_eye_state(self) -> bool:
        return self._figure in ("wavefront", "acuity")


def describe_point(facts: dict[str, float]) -> str:
    """Describe a point's position and the width of its image."""
    h_deg, v_deg = facts["h_deg"], facts["v_deg"]
    across = f"{abs(h_deg):.1f}° {'right' if h_deg >= 0 else 'left'} of"
    along = f"{abs(v_deg):.1f}° {'above' if v_deg >= 0 else 'below'}"
    return (
        f"{across} and {along} the gaze direction, at "
        f"{distance_text(facts['object_dpt'])}. Half of the point's light lies within "
        f"{facts['half_light_arcmin']:.1f} arcmin of its center: a spot about as wide "
        f"as {nearest_familiar_object(facts['half_light_arcmin'])}."
    )


def nearest_familiar_object(radius_arcmin: float) -> str:
    """Return the familiar object closest in angular size to the spot (by ratio)."""
    diameter_arcmin = 2.0 * radius_arcmin
    return min(
        WIDTHS_ARCMIN.items(),
        key=lambda item: abs(math.log(item[1] / max(diameter_arcmin, 1e-3))),
    )[0]
