"""Side panel: the point under the pointer, and figures of the eye."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.web.eye_figures import FIGURE_TITLES, eye_figure
from clients.web.eye_form import SIDES, EyeSide
from clients.web.figure_worker import FigureWorker, StudyFailed
from clients.web.numbers import distance_text
from clients.web.page_state import FOCUS, PUPIL, PageState
from clients.web.point_spread import PointState, point_spread


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
        self._page, self._state, self._studying = page, state, figure_worker
        self._side: EyeSide = "OD"
        self._at = (0.5, 0.5)
        self._figure = next(iter(FIGURE_TITLES))
        self._drawn: Any = None
        with ui.element("section").classes("oc-card"):
            ui.label("A point of light here").classes("oc-title")
            self._psf = ui.html("", sanitize=False).classes("oc-psf")
            self._told = ui.label("Move the pointer over the picture.").classes(
                "oc-hint"
            )
        with ui.element("section").classes("oc-card"):
            self._title = ui.label("").classes("oc-title")
            ui.toggle(FIGURE_TITLES, value=self._figure, on_change=self._choose).props(
                "no-caps unelevated spread dense"
            ).classes("oc-toggle")
            self._image = ui.html("", sanitize=False).classes("oc-figure")

    async def point(self, side: EyeSide, x: float, y: float) -> None:
        """Show the point-spread function at a position in the picture."""
        self._side, self._at = side, (x, y)
        await self._show_point()

    async def renew(self) -> None:
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
        """Ask the worker process; return None if it failed or a newer request came."""
        try:
            return await self._studying.ask(
                self._page, kind, function, *args, **options
            )
        except StudyFailed as error:
            self._told.text = str(error)
            return None

    def _body(self) -> str | None:
        body = self._state.looking_body(self._side)
        return None if body is None else json.dumps(body, sort_keys=True)

    async def _show_point(self) -> None:
        body, place = self._body(), self._state.place(*self._at)
        if body is None or place is None:
            return
        values = self._state.values
        point = PointState(
            direction_deg=place.direction_deg(self._state.gaze_deg),
            object_dpt=place.distance_dpt,
            pupil_diameter_mm=values[PUPIL.name],
            focus_dpt=values[FOCUS.name],
        )
        answer = await self._ask("point", point_spread, body, point)
        if answer is None:
            return
        png, facts = answer
        self._psf.content = f'<img src="{data_url(png)}" alt="Light of the point">'
        self._told.text = point_words(facts)

    async def _show_figure(self) -> None:
        self._title.text = SIDES[self._side]
        body, values = self._body(), self._state.values
        state = {name: values[name] for name in (PUPIL.name, FOCUS.name)}
        wanted = (self._figure, body, *(state.values() if self._is_of_state else ()))
        if body is None or wanted == self._drawn:
            return
        png = await self._ask("figure", eye_figure, self._figure, body, **state)
        if png is not None:
            self._drawn = wanted
            title = FIGURE_TITLES[self._figure]
            self._image.content = f'<img src="{data_url(png)}" alt="{title}">'

    @property
    def _is_of_state(self) -> bool:
        return self._figure in ("wavefront", "acuity")


def point_words(facts: dict[str, float]) -> str:
    """Describe a point's position and the width of its light."""
    across = f"{abs(facts['h_deg']):.1f}° {'right' if facts['h_deg'] >= 0 else 'left'}"
    along = f"{abs(facts['v_deg']):.1f}° {'up' if facts['v_deg'] >= 0 else 'down'}"
    return (
        f"{across}, {along} of the gaze, at {distance_text(facts['object_dpt'])}. "
        f"Half of its light lies within {facts['half_light_arcmin']:.1f} arcmin."
    )
