"""The pictures on the page: the scene, the element and the websocket.

The element's browser part is picture_view.js.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState
from nicegui import events, run, ui
from nicegui.element import Element

from clients.acuity_text import NOTATION_TITLES, Notation, acuity_text
from clients.scenes.letter_chart import letter_height
from clients.web.comparison import EyeName
from clients.web.controls import DISTANCE, distance_text
from clients.web.filter_thread import SentPicture
from clients.web.page_state import SCENES, PageState
from clients.web.picture import (
    DEPTH_HELP,
    DEPTH_SUFFIXES,
    GLTF_SUFFIXES,
    MAX_GLTF_BYTES,
    MAX_PHOTO_BYTES,
    TITLES,
    Picture,
    chart_picture,
    gltf_picture,
    photo_picture,
    scene_picture,
)
from clients.web.widgets import (
    UploadHandler,
    problem_label,
    select,
    toggle,
    upload_entry,
)

KINDS = {
    **TITLES,
    "chart": "Letter chart",
    "photo": "Photo",
    "gltf": "3D file",
}
PHOTO_WIDTHS_DEG = {20: "20° wide", 35: "35° wide", 50: "50° wide", 70: "70° wide"}
PHOTO_DISTANCES = {
    "": "Choose: all of it is at one distance",
    "inf": "Landscape, far away",
    "4": "Room or street, 4 m",
    "1.5": "Person, 1.5 m",
    "0.66": "Screen, 66 cm",
    "0.4": "Page or close-up, 40 cm",
    "0.2": "Close-up, 20 cm",
}
"""Distance of what a photo shows, in meters, and its text."""

NamedFile = tuple[str, bytes]

MAX_AT_ONCE = 2
"""Pictures computed at the same time; a photo of 64 Mpx takes 0.6 GB."""

MAX_WAITING = 4
"""Limit on pictures of one page that are computed or queued, each with its file."""

_picture_slots = asyncio.Semaphore(MAX_AT_ONCE)

HALF_WIDTH_HEIGHTS = 4.5
"""Half of a chart row's width in letter heights: five letters and their gaps."""


COLUMN_HEADS: Mapping[Notation, str] = {
    "log_mar": "logMAR",
    "decimal": "dec.",
    "feet": "feet",
    "meters": "meters",
}
CAPTION_NAMES: Mapping[Notation, str] = {
    "log_mar": "logMAR ",
    "decimal": "decimal ",
    "feet": "",
    "meters": "",
}


class ScenePanel:
    """Select the scene; pictures are computed outside the event loop.

    Parameters
    ----------
    on_picture : called with each new picture
    on_empty : called with a text if the selected scene has no file yet
    on_notation : called when another notation of acuity was chosen
    on_distance : called with the distance of what a photo shows, in meters

    Attributes
    ----------
    kind : the selected scene, one of `KINDS`
    """

    def __init__(
        self,
        state: PageState,
        on_picture: Callable[[Picture], None],
        on_empty: Callable[[str], None],
        *,
        on_notation: Callable[[], None],
        on_distance: Callable[[float], None],
    ) -> None:
        self._state, self._on_picture, self._on_empty = state, on_picture, on_empty
        self._on_notation, self._on_distance = on_notation, on_distance
        self._photo_distance = ""
        self.kind = SCENES[0]
        self._gltf: Picture | None = None
        self._n_waiting = 0
        self._photo: NamedFile | None = None
        self._depth: NamedFile | None = None
        self._notes: tuple[str, ...] = ()
        self._width_deg = 35
        with ui.element("div").classes("oc-scene"):
            self._kinds = toggle(
                KINDS, self.kind, self._choose, label="Scene", kind="oc-kinds"
            )
            self._busy = ui.spinner(size="1.4em").classes("oc-busy")
            self._busy.set_visibility(False)
            self._notation = select(
                dict(NOTATION_TITLES),
                state.notation,
                self._set_notation,
                label="Acuity as",
            ).classes("oc-notation")

    def build_uploads(self) -> None:
        """Build the uploads of a photo or a 3D file, which the scene may need."""
        self._problem = problem_label()
        self._uploads()

    @ui.refreshable_method
    def _uploads(self) -> None:
        """Show the uploads of a photo or a 3D file."""
        uploads: dict[str, list[tuple[str, Sequence[str], int, UploadHandler]]] = {
            "gltf": [("glTF 2 scene", GLTF_SUFFIXES, MAX_GLTF_BYTES, self._take_gltf)],
            "photo": [
                ("Photo", ("image/*",), MAX_PHOTO_BYTES, self._take_photo),
                (
                    *("Its depth, if known", DEPTH_SUFFIXES, MAX_PHOTO_BYTES),
                    self._take_depth,
                ),
            ],
        }
        if self.kind not in uploads:
            return
        with ui.element("div").classes("oc-uploads"):
            for label, suffixes, max_bytes, take in uploads[self.kind]:
                upload_entry(label, ",".join(suffixes), max_bytes, take).mark(label)
            if self.kind == "gltf":
                return
            with ui.element("div").classes("oc-photo-width"):
                select(
                    PHOTO_WIDTHS_DEG,
                    self._width_deg,
                    self._set_width,
                    label="Field of view of the photo",
                )
                self._distances = select(
                    PHOTO_DISTANCES,
                    self._photo_distance,
                    self._set_photo_distance,
                    label="Distance of what the photo shows",
                )
                self._distance_note = ui.label().classes("oc-note oc-ask")
                self._distance_note.props("aria-live=polite")
                ui.label(f"Depth: {DEPTH_HELP}.").classes("oc-hint")
                self._used = ui.label().classes("oc-note")
                self._show_files()

    def _show_files(self) -> None:
        """Show the names of the files in use."""
        names = [file[0] for file in (self._photo, self._depth) if file is not None]
        text = f"In use: {', '.join(names)}" if names else ""
        if names and self._photo is None:
            text += ". Now upload the photo that this depth belongs to."
        self._used.text = ". Note: ".join((text, *self._notes))
        is_asked = self._photo is not None and self._depth is None
        distance = distance_text(self._state.values[DISTANCE.name])
        self._distance_note.text = (
            f"The whole photo is shown at {distance}. Choose the distance of what it "
            "shows: the picture depends on it."
            if is_asked and not self._photo_distance
            else ""
        )

    def _set_photo_distance(self, event: events.ValueChangeEventArguments) -> None:
        self._photo_distance = event.value
        if event.value:
            self._on_distance(float(event.value))
        self._show_files()

    def _set_notation(self, event: events.ValueChangeEventArguments) -> None:
        if event.value != self._state.notation:
            self._state.notation = event.value
            self._on_notation()

    def show_notation(self) -> None:
        """Show the notation of the page's state."""
        self._notation.value = self._state.notation

    def choose(self, kind: str) -> None:
        """Select a scene, like a click on its button."""
        self._kinds.value = kind

    async def _choose(self, event: events.ValueChangeEventArguments) -> None:
        self.kind = event.value
        self._problem.text = ""
        self._uploads.refresh()
        await self._show()

    async def _set_width(self, event: events.ValueChangeEventArguments) -> None:
        self._width_deg = event.value
        await self._show()

    async def _show(self) -> None:
        """Show the selected scene, or a message about missing input."""
        try:
            if self.kind in TITLES:
                await self._compute(scene_picture, self.kind)
            elif self.kind == "chart":
                await self._compute(chart_picture, self._state.values[DISTANCE.name])
            elif self.kind == "gltf":
                if self._gltf is None:
                    self._on_empty("No 3D file yet: upload one")
                else:
                    self._on_picture(self._gltf)
            elif self._photo is None:
                self._on_empty("No photo yet: upload one")
            else:
                await self._show_photo(self._photo, self._depth)
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
        else:
            await self._show_photo(self._photo, (name, content))

    async def _show_photo(self, photo: NamedFile, depth: NamedFile | None) -> None:
        """Show a photo; if one of its files is rejected, keep the previous ones."""
        picture = await self._compute(
            photo_picture,
            *photo,
            width_deg=self._width_deg,
            distance_dpt=self._state.values[DISTANCE.name],
            depth=depth,
        )
        if self._photo != photo:  # another photo may show something else
            self._distances.value = ""
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
        kind = self.kind
        self._problem.text = ""
        self._busy.set_visibility(True)
        self._n_waiting += 1
        try:
            async with _picture_slots:
                picture = await run.io_bound(make, *args, **options)
        finally:
            self._n_waiting -= 1
            self._busy.set_visibility(self._n_waiting > 0)
        if (
            picture is not None and kind == self.kind
        ):  # otherwise another scene was selected
            self._on_picture(picture)
        return picture


class PictureSender:
    """Queue of the pictures of one page; use it on the event loop's thread.

    A newer picture replaces a queued one of the same slot, so that a slow connection
    lags by one picture at most.

    Attributes
    ----------
    last : dict
        The last picture of each slot: an eye, or the scene.
    """

    def __init__(self) -> None:
        self.last: dict[str, SentPicture] = {}
        self._queued: dict[str, SentPicture] = {}
        self._new_picture = asyncio.Event()

    def put(self, seen: SentPicture) -> None:
        """Queue a picture."""
        slot = seen.eye or seen.kind
        self._queued[slot] = self.last[slot] = seen
        self._new_picture.set()

    def is_final(self, side: EyeName, number: int) -> bool:
        """Return whether the full picture of a request was sent or has failed."""
        seen = self.last.get(side)
        return (
            seen is not None
            and seen.kind in ("full", "failed")
            and seen.number == number
        )

    async def serve(self, socket: WebSocket) -> None:
        """Send pictures until the client disconnects; resend all after a reconnect."""
        await socket.accept()
        self._queued = dict(self.last)
        self._new_picture.set()
        disconnected = asyncio.ensure_future(_wait_for_disconnect(socket))
        try:
            while not disconnected.done():
                new_picture = asyncio.ensure_future(self._new_picture.wait())
                await asyncio.wait(
                    {new_picture, disconnected}, return_when=asyncio.FIRST_COMPLETED
                )
                new_picture.cancel()
                self._new_picture.clear()
                while self._queued and not disconnected.done():
                    slot = next(iter(self._queued))
                    await socket.send_bytes(self._queued.pop(slot).packed())
        except WebSocketDisconnect:
            pass  # the client disconnected during a send
        except RuntimeError:
            states = {socket.client_state, socket.application_state}
            if states == {WebSocketState.CONNECTED} and not disconnected.done():
                raise  # any other error is ours
        finally:
            disconnected.cancel()


async def _wait_for_disconnect(socket: WebSocket) -> None:
    """Wait until the client disconnects; it sends nothing else."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


# nicegui, which takes the name of the component, has no types here
class PictureView(Element, component="picture_view.js"):  # type: ignore[call-arg]
    """Scene and filtered pictures, or states A and B, with a split between them.

    The events ``point`` and ``look`` report the position of the pointer and of a click:
    the eye, and x and y from 0 to 1.

    Parameters
    ----------
    address : str
        Address of the websocket that sends the pictures.
    """

    def __init__(self, address: str, aspect: float) -> None:
        super().__init__()
        self.show(
            address=address,
            eyes=[],
            labels_of={},
            behind_one=False,
            whole=False,
            aspect=aspect,
            scene="",
            alts={},
            marks=[],
            marks_head=[],
            captions={},
            empty="",
        )

    def show(self, **props: Any) -> None:
        """Show other values.

        Parameters
        ----------
        eyes, labels_of : list of str, dict
            The eyes or states shown, and their names as displayed.
        behind_one : bool
            Whether two states share one split, instead of each having one beside the
            scene.
        whole : bool
            Whether each picture is shown whole, without the scene and a split.
        scene, aspect : str, float
            Title of the scene, and the ratio of its width to its height.
        empty : str
            Text in place of the pictures; an empty one shows the pictures.
        alts : dict
            Text alternative of each eye's image.
        marks, captions : list, dict
            Labels beside the rows of a chart, and the caption of each eye.
        """
        self._props.update(props)
        self.update()

    def mark_rows(
        self,
        picture: Picture,
        smallest_rows: Mapping[EyeName, int | None],
        notation: Notation,
    ) -> None:
        """Label the rows of a chart, and describe the row that each eye just reads.

        Parameters
        ----------
        smallest_rows : index of the smallest row that each eye can read, or None
        notation : of acuity, beside logMAR
        """
        right = picture.view.tangents[1]
        shown: list[Notation] = list(dict.fromkeys(("log_mar", notation)))
        texts = [
            [acuity_text(row.log_mar, each) for each in shown]
            for row in picture.chart_rows
        ]
        self.show(
            marks_head=[COLUMN_HEADS[each] for each in shown],
            marks=[
                {
                    "y": row.y_px / picture.view.height_px,
                    "x": 0.5
                    + letter_height(row.log_mar) * HALF_WIDTH_HEIGHTS / right / 2.0,
                    "texts": texts[k],
                    "eyes": [eye for eye, read in smallest_rows.items() if read == k],
                }
                for k, row in enumerate(picture.chart_rows)
            ],
            captions={
                eye: (
                    "reads none of these lines"
                    if read is None
                    else "reads about the line "
                    + ", ".join(
                        f"{CAPTION_NAMES[each]}{text}"
                        for each, text in zip(shown, texts[read], strict=True)
                    )
                )
                for eye, read in smallest_rows.items()
            },
        )
