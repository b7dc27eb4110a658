"""Side panel of the web page: point-spread function at the pointer, and figures."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.scenes.letter_chart import smallest_row
from clients.web.controls import DISTANCE, distance_text
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import (
    FIGURE_TITLES,
    Ask,
    FigureFailed,
    eye_figure,
    point_spread,
    predicted_log_mar,
)
from clients.web.page_state import PageState
from clients.web.widgets import card, title, toggle

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


class FigurePanel:
    """Point-spread function and figures of one eye.

    Parameters
    ----------
    ask : runs a function in the worker process, for this page
    """

    def __init__(self, state: PageState, ask: Ask) -> None:
        self._state, self._ask = state, ask
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
        with card("Point of light", "oc-point"):
            title("How a point of light looks here")
            self._psf = self._picture_button("oc-psf", "the point of light")
            self._message = ui.label("Move the pointer over the picture.")
            self._message.classes("oc-hint")

    def build_figure(self) -> None:
        """Build the figure card."""
        with card("Figures"):
            self._title = title("Figures")
            toggle(
                FIGURE_TITLES,
                self._figure,
                self._choose,
                label="Figure",
                props="spread",
                kind="oc-figures",
            )
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

    async def _answer(
        self, kind: str, function: Callable[..., Any], *args: Any, **options: Any
    ) -> Any:
        """Run a function in the worker.

        Return None if it fails or a newer request supersedes it.
        """
        try:
            return await self._ask(kind, function, *args, **options)
        except FigureFailed as error:
            self._message.text = str(error)
            return None

    def _body(self, side: EyeSide) -> str | None:
        """Return an eye's profile as JSON, the cache key of the worker."""
        body = self._state.profile_at_gaze(side)
        return None if body is None else json.dumps(body, sort_keys=True)

    async def _show_point(self) -> None:
        body, picture = self._body(self._side), self._state.picture
        if body is None or picture is None:
            return
        scene_point = picture.scene_point(*self._at)
        answer = await self._answer(
            "point",
            point_spread,
            body,
            direction_deg=scene_point.direction_deg(self._state.picture_gaze_deg),
            object_dpt=scene_point.distance_dpt,
            **self._state.eye_state,
        )
        if answer is not None:
            png, facts = answer
            self._psf.content = _image(png, "Image of the point of light")
            self._message.text = describe_point(facts)

    async def smallest_rows(self) -> dict[EyeSide, int | None] | None:
        """Return the smallest chart row that each eye can read; None if it reads none.

        Return None if a request failed or was superseded.  An eye whose acuity is
        unknown is omitted.
        """
        picture = self._state.picture
        rows = [row.log_mar for row in picture.chart_rows] if picture else []
        found: dict[EyeSide, int | None] = {}
        for side in self._state.sides if rows else ():
            body = self._body(side)
            if body is None:
                continue
            log_mar = await self._answer(
                f"acuity {side}",
                predicted_log_mar,
                body,
                object_dpt=self._state.values[DISTANCE.name],
                **self._state.eye_state,
            )
            if log_mar is None:
                return None
            if not math.isnan(log_mar):
                found[side] = smallest_row(rows, log_mar)
        return found

    async def _show_figure(self) -> None:
        self._title.content = f"Figures: {SIDES[self._side].lower()}"
        body, state = self._body(self._side), self._state.eye_state
        depends_on_state = self._figure in ("wavefront", "acuity")
        request = self._figure, body, state if depends_on_state else None
        if body is None or request == self._drawn_request:
            return
        png = await self._answer("figure", eye_figure, self._figure, body, **state)
        if png is not None:
            self._drawn_request = request
            self._image.content = _image(png, FIGURE_TITLES[self._figure])


def _image(png: bytes, text: str) -> str:
    """Return the HTML of a picture with its text alternative."""
    data = base64.b64encode(png).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{text}">'


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
    diameter_arcmin = max(2.0 * radius_arcmin, 1e-3)
    return min(
        WIDTHS_ARCMIN, key=lambda k: abs(math.log(WIDTHS_ARCMIN[k] / diameter_arcmin))
    )
