"""Selection of the scene on the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import events, run, ui

from clients.web.chart import chart_picture
from clients.web.page_state import DISTANCE, PageState
from clients.web.picture import (
    DEPTH_HELP,
    DEPTH_SUFFIXES,
    MAX_PHOTO_BYTES,
    Picture,
    photo_picture,
)
from clients.web.scene_file import (
    GLTF_SUFFIXES,
    MAX_GLTF_BYTES,
    TITLES,
    SceneNotRendered,
    gltf_picture,
    scene_picture,
)
from clients.web.upload_entry import UploadHandler, upload_entry

KINDS = {**TITLES, "chart": "Letter chart", "photo": "Photo", "gltf": "3D file"}
PHOTO_WIDTHS_DEG = {20: "20° wide", 35: "35° wide", 50: "50° wide", 70: "70° wide"}
DEFAULT_SCENE = "courtyard"
NamedFile = tuple[str, bytes]

MAX_AT_ONCE = 2
"""Pictures computed at the same time; a photo of 64 Mpx takes 0.6 GB."""

MAX_WAITING = 4
"""Limit on pictures of one page that are computed or queued, each with its file."""

_picture_slots = asyncio.Semaphore(MAX_AT_ONCE)


class ScenePanel:
    """Select the scene; pictures are computed outside the event loop.

    Parameters
    ----------
    on_picture : called with each new picture
    on_empty : called with a text if the selected scene has no file yet
    kind : first scene, one of `KINDS`
    """

    def __init__(
        self,
        state: PageState,
        on_picture: Callable[[Picture], None],
        on_empty: Callable[[str], None],
        kind: str,
    ) -> None:
        self._state, self._on_picture, self._on_empty = state, on_picture, on_empty
        self._kind = kind
        self._gltf: Picture | None = None
        self._n_waiting = 0
        self._photo: NamedFile | None = None
        self._depth: NamedFile | None = None
        self._notes: tuple[str, ...] = ()
        self._width_deg = 35
        with ui.element("div").classes("oc-scene"):
            self._kinds = (
                ui.toggle(KINDS, value=kind, on_change=self._choose)
                .props("no-caps unelevated dense role=group aria-label=Scene")
                .classes("oc-toggle oc-kinds")
            )
            self._busy = ui.spinner(size="1.4em").classes("oc-busy")
            self._busy.set_visibility(False)
        self._problem = ui.label("").classes("oc-problem").props("role=alert")
        self._uploads()

    @ui.refreshable_method
    def _uploads(self) -> None:
        """Show the uploads of a photo or a 3D file."""
        if self._kind not in ("photo", "gltf"):
            return
        with ui.element("div").classes("oc-uploads"):
            if self._kind == "gltf":
                suffixes = ",".join(GLTF_SUFFIXES)
                self._upload("glTF 2 scene", suffixes, MAX_GLTF_BYTES, self._take_gltf)
                return
            self._upload("Photo", "image/*", MAX_PHOTO_BYTES, self._take_photo)
            suffixes = ",".join(DEPTH_SUFFIXES)
            self._upload(
                "Its depth, if known", suffixes, MAX_PHOTO_BYTES, self._take_depth
            )
            with ui.element("div").classes("oc-photo-width"):
                ui.select(
                    PHOTO_WIDTHS_DEG,
                    value=self._width_deg,
                    on_change=self._set_width,
                    label="Field of view of the photo",
                ).props("outlined dense options-dense")
                ui.label(
                    f"Depth: {DEPTH_HELP}.  Without depth, the whole photo is at one "
                    "distance."
                ).classes("oc-hint")
                self._used = ui.label().classes("oc-note")
                self._show_files()

    def _upload(
        self, label: str, accept: str, max_bytes: int, take: UploadHandler
    ) -> None:
        upload_entry(label, accept, max_bytes, take).mark(label)

    def _show_files(self) -> None:
        """Show the names of the files in use."""
        names = [file[0] for file in (self._photo, self._depth) if file is not None]
        text = f"In use: {', '.join(names)}" if names else ""
        if names and self._photo is None:
            text += ". Now upload the photo that this depth belongs to."
        self._used.text = ". Note: ".join((text, *self._notes))

    @property
    def kind(self) -> str:
        """Return the selected scene."""
        return self._kind

    def choose(self, kind: str) -> None:
        """Select a scene, like a click on its button."""
        self._kinds.value = kind

    async def _choose(self, event: events.ValueChangeEventArguments) -> None:
        self._kind = event.value
        self._problem.text = ""
        self._uploads.refresh()
        try:
            if self._kind in TITLES:
                await self._compute(scene_picture, self._kind)
            elif self._kind == "chart":
                await self._compute(chart_picture, self._state.values[DISTANCE.name])
            elif self._kind == "photo":
                if self._photo is None:
                    self._on_empty("No photo yet: upload one")
                await self._show_again()
            elif self._gltf is None:
                self._on_empty("No 3D file yet: upload one")
            else:
                self._on_picture(self._gltf)
        except ValueError as error:
            self._problem.text = str(error)

    async def _take_gltf(self, name: str, content: bytes) -> None:
        self._gltf = await self._compute(gltf_picture, name, content)

    async def _take_photo(self, name: str, content: bytes) -> None:
        # A depth file uploaded first belongs to this photo, any other to the last one.
        depth = self._depth if self._photo is None else None
        try:
            await self._show_photo((name, content), depth)
        except ValueError:
            if self._photo is None:
                self._depth = None  # it may be the rejected file
                self._show_files()
            raise

    async def _take_depth(self, name: str, content: bytes) -> None:
        if self._photo is None:
            self._depth = name, content
            self._show_files()
            return
        await self._show_photo(self._photo, (name, content))

    async def _set_width(self, event: events.ValueChangeEventArguments) -> None:
        self._width_deg = event.value
        try:
            await self._show_again()
        except ValueError as error:
            self._problem.text = str(error)

    async def _show_again(self) -> None:
        if self._photo is not None:
            await self._show_photo(self._photo, self._depth)

    async def _show_photo(self, photo: NamedFile, depth: NamedFile | None) -> None:
        """Show a photo; if one of its files is rejected, keep the previous ones."""
        picture = await self._compute(
            photo_picture,
            *photo,
            width_deg=self._width_deg,
            distance_dpt=self._state.values[DISTANCE.name],
            depth=depth,
        )
        self._photo, self._depth = photo, depth
        self._notes = () if picture is None else picture.notes
        self._show_files()

    async def _compute(
        self, make: Callable[..., Picture], *args: Any, **options: Any
    ) -> Picture:
        """Compute a picture with a function, show it and return it.

        Raises
        ------
        ValueError
            If the picture cannot be computed.
        """
        if self._n_waiting >= MAX_WAITING:
            raise ValueError("Still rendering; try again")
        kind = self._kind
        self._problem.text = ""
        self._busy.set_visibility(True)
        self._n_waiting += 1
        try:
            async with _picture_slots:
                picture = await run.io_bound(make, *args, **options)
        except SceneNotRendered as error:
            raise ValueError(str(error)) from None
        finally:
            self._n_waiting -= 1
            self._busy.set_visibility(self._n_waiting > 0)
        if (
            picture is not None and kind == self._kind
        ):  # otherwise another scene was selected
            self._on_picture(picture)
        return picture
