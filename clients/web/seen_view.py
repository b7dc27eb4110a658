"""The pictures as an element of the page; the browser's part is seen_view.js."""

from nicegui.element import Element


class SeenView(Element, component="seen_view.js"):
    """Scene and what eyes see of it, with a split between them.

    Events ``point`` and ``look`` say where the pointer is, and where it clicked: the
    eye, and x and y from 0 to 1.

    Parameters
    ----------
    address : str
        Of the websocket that the pictures come from.
    """

    def __init__(self, address: str, eyes: list[str], aspect: float) -> None:
        super().__init__()
        self._props["address"] = address
        self._props["eyes"] = eyes
        self._props["aspect"] = aspect

    def show_eyes(self, eyes: list[str]) -> None:
        """Show these eyes."""
        self._props["eyes"] = eyes

    def show_aspect(self, ratio: float) -> None:
        """Give pictures another shape, width over height."""
        self._props["aspect"] = ratio
