"""Page element that shows the pictures; its browser part is picture_view.js."""

from collections.abc import Mapping, Sequence
from typing import Any

from nicegui.element import Element

from clients.web.eye_form import EyeSide


# nicegui, which takes the name of the component, has no types here
class PictureView(Element, component="picture_view.js"):  # type: ignore[call-arg]
    """Scene and filtered pictures, with a split between them.

    The events ``point`` and ``look`` report the position of the pointer and of a click:
    the eye, and x and y from 0 to 1.

    Parameters
    ----------
    address : str
        Address of the websocket that sends the pictures.
    """

    def __init__(self, address: str, eyes: list[str], aspect: float) -> None:
        super().__init__()
        self._props.update(
            {
                "address": address,
                "eyes": eyes,
                "aspect": aspect,
                "scene": "",
                "alts": {},
                "marks": [],
                "captions": {},
                "empty": "",
            }
        )

    def show_eyes(self, eyes: list[str]) -> None:
        """Show these eyes."""
        self._props["eyes"] = eyes
        self.update()

    def show_scene(self, title: str, ratio: float) -> None:
        """Set the scene's title and the ratio of its width to its height."""
        self._props["scene"], self._props["aspect"] = title, ratio
        self.show_empty("")

    def show_empty(self, text: str) -> None:
        """Show a text in place of the pictures; an empty one shows the pictures."""
        self._props["empty"] = text
        self.update()

    def describe(self, alts: Mapping[EyeSide, str]) -> None:
        """Set the text alternative of each eye's image."""
        self._props["alts"] = dict(alts)
        self.update()

    def mark_rows(
        self, marks: Sequence[Mapping[str, Any]], captions: Mapping[EyeSide, str]
    ) -> None:
        """Set the labels beside rows of a chart, and the caption of each eye.

        Parameters
        ----------
        marks : sequence of mapping
            ``y`` and ``x`` of the row's right end from 0 to 1, ``log_mar`` and
            ``decimal`` as text, and ``eyes``: the eyes whose smallest line this is.
        """
        self._props["marks"] = [dict(mark) for mark in marks]
        self._props["captions"] = dict(captions)
        self.update()
