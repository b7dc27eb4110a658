"""Side panel of the web page: point-spread function at the pointer, and figures."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.web.blur_widths import nearest_familiar_object
from clients.web.comparison import EyeName
from clients.web.controls import distance_text
from clients.web.figure_worker import (
    FIGURE_TITLES,
    Ask,
    FigureFailed,
    eye_figures,
    point_spread,
    predicted_sight,
)
from clients.web.page_state import PageState
from clients.web.widgets import card, help_button, title, toggle

LEAST_OFFSET_DEG = 0.05
PREPARING = "Preparing the point of light of these entries…"

POINT_HELP = (
    "The image of a single point of light on the retina, at the pointer. The smaller "
    "the spot, the sharper the sight. A normal eye is sharpest where it looks; toward "
    "the side, the image blurs, which one does not notice, because the retina resolves "
    "little there. Colors separate because the eye focuses blue nearer than red."
)
FIGURES_HELP = (
    "Figures of the eye as the report has them. Click a figure to enlarge it. Two eyes "
    "or states are drawn in one diagram or beside each other."
)
FIGURE_TEXTS = {
    "wavefront": "Deviation of the light from a perfect focus over the pupil: the more "
    "even the color, the sharper the image. RMS is its mean size; below 0.07 µm the "
    "image of a point hardly differs from a perfect one. Rings of a multifocal lens "
    "are not included.",
    "field": "Refraction and blur by direction, as the person sees the surroundings. "
    "The center is where the person looks. Blur toward the side is normal.",
    "section": "The eye from the side, with the lens and the rays of a far point.",
    "acuity": "Predicted acuity by distance: higher is better. 0.0 logMAR is 1.0, "
    "20/20 or 6/6. It is a prediction from optics for a healthy retina.",
    "contrast": "Share of the contrast of a grating that reaches the retina: coarse "
    "patterns at the left, fine ones at the right. 30 cycles per degree is the detail "
    "of the 1.0 (20/20) line.",
}


class FigurePanel:
    """Point-spread function and figures of one eye.

    Parameters
    ----------
    ask : runs a function in the worker process, for this page
    """

    def __init__(self, state: PageState, ask: Ask) -> None:
        self._state, self._ask = state, ask
        self._name: EyeName = "OD"
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
            with ui.element("div").classes("oc-line"):
                title("How a point of light looks here")
                help_button("a point of light", POINT_HELP)
            with ui.element("div").classes("oc-points"):
                self._psfs = [
                    self._picture_button("oc-psf", what)
                    for what in ("the point of light", "the point of light in B")
                ]
            self._message = ui.label("Move the pointer over the picture.")
            self._message.classes("oc-hint")

    def build_figure(self) -> None:
        """Build the figure card."""
        with card("Figures"):
            with ui.element("div").classes("oc-line"):
                self._title = title("Figures")
                help_button("the figures", FIGURES_HELP)
            toggle(
                FIGURE_TITLES,
                self._figure,
                self._choose,
                label="Figure",
                props="spread",
                kind="oc-figures",
            )
            with ui.element("div").classes("oc-figure-row"):
                self._image = self._picture_button("oc-figure", "the figure")
                self._explanation = ui.label(FIGURE_TEXTS[self._figure])
                self._explanation.classes("oc-hint oc-explanation")

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

    async def point(self, name: EyeName, x: float, y: float) -> None:
        """Show the point-spread function at a position in the picture."""
        self._name, self._at = name, (x, y)
        await self._show_point()

    async def refresh(self) -> None:
        """Redraw everything after a change of the eye or its state."""
        await self._show_point()
        await self._show_figure()

    async def _choose(self, event: events.ValueChangeEventArguments) -> None:
        self._figure = event.value
        self._explanation.text = FIGURE_TEXTS[self._figure]
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

    def _body(self, name: EyeName) -> str | None:
        """Return an eye's profile as JSON, the cache key of the worker."""
        body = self._state.profile_at_gaze(name)
        return None if body is None else json.dumps(body, sort_keys=True)

    def mark_outdated(self) -> None:
        """Say that the points of light shown are those of former entries."""
        self._message.text = PREPARING
        for psf in self._psfs:
            if psf.content:
                psf.classes("oc-outdated")

    async def _show_point(self) -> None:
        """Show the point of light of the eye at the pointer, or of both states."""
        state = self._state
        names = state.names if state.is_comparing else (self._name,)
        if names[0] not in state.names:
            names = state.names[:1]
        for psf in self._psfs[len(names) :]:
            psf.content = ""
            psf.classes(remove="oc-outdated")
        messages: list[str] = []
        for name, psf in zip(names, self._psfs, strict=False):
            body, picture = self._body(name), state.picture
            if body is None or picture is None:
                return
            scene_point = picture.scene_point(*self._at)
            answer = await self._answer(
                f"point {len(messages)}",
                point_spread,
                body,
                direction_deg=scene_point.direction_deg(state.picture_gaze_deg),
                object_dpt=scene_point.distance_dpt,
                **state.eye_state,
            )
            if answer is None:
                return
            png, facts = answer
            shown = state.title(name)
            psf.content = _image(png, f"Image of the point of light, {shown}")
            psf.classes(remove="oc-outdated")
            start = f"{shown}: " if state.is_comparing else ""
            if not messages:
                start = f"{describe_place(facts)} {start}"
            messages.append(start + describe_width(facts))
        self._message.text = "\n".join(messages)

    async def sights(self) -> dict[EyeName, dict[str, Any]] | None:
        """Return the acuity of each eye for what it looks at: see `sight_numbers`.

        Return None if a request failed or was superseded.
        """
        found: dict[EyeName, dict[str, Any]] = {}
        for name in self._state.names:
            body = self._body(name)
            if body is None:
                continue
            sight = await self._answer(
                f"acuity {name}",
                predicted_sight,
                body,
                object_dpt=self._state.object_dpt,
                **self._state.eye_state,
            )
            if sight is None:
                return None
            found[name] = sight
        return found

    async def _show_figure(self) -> None:
        state = self._state
        self._title.content = f"Figures: {state.titles}"
        bodies = [self._body(name) for name in state.names]
        known = [body for body in bodies if body is not None]
        depends_on_state = self._figure in ("wavefront", "acuity", "contrast")
        eye_state = state.eye_state
        request = self._figure, known, eye_state if depends_on_state else None
        if len(known) < len(bodies) or request == self._drawn_request:
            return
        labels = [state.title(name) for name in state.names]
        png = await self._answer(
            "figure", eye_figures, self._figure, known, labels, **eye_state
        )
        if png is not None:
            self._drawn_request = request
            kind = "oc-wide-figure" if len(known) > 1 else ""
            self._image.content = _image(png, FIGURE_TITLES[self._figure], kind)


def _image(png: bytes, text: str, kind: str = "") -> str:
    """Return the HTML of a picture with its text alternative."""
    data = base64.b64encode(png).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{text}" class="{kind}">'


def describe_place(facts: dict[str, float]) -> str:
    """Describe the position of a point of the scene."""
    h_deg, v_deg = facts["h_deg"], facts["v_deg"]
    distance = f"at {distance_text(facts['object_dpt'])}."
    if max(abs(h_deg), abs(v_deg)) < LEAST_OFFSET_DEG:
        return f"In the gaze direction, {distance}"
    across = f"{abs(h_deg):.1f}° {'right' if h_deg >= 0 else 'left'} of"
    along = f"{abs(v_deg):.1f}° {'above' if v_deg >= 0 else 'below'}"
    return f"{across} and {along} the gaze direction, {distance}"


def describe_width(facts: dict[str, float]) -> str:
    """Describe the width of the image of a point."""
    half_light_arcmin = facts["half_light_arcmin"]
    return (
        f"A spot about as wide as {nearest_familiar_object(half_light_arcmin)}. "
        f"Half of the point's light lies within {half_light_arcmin:.1f} arcmin of its "
        "center."
    )
