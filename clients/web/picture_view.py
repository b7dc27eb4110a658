"""Page element that shows the pictures; its browser part is picture_view.js."""

from nicegui.element import Element


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
        self._props["address"] = address
        self._props["eyes"] = eyes
        self._props["aspect"] = aspect

    def show_eyes(self, eyes: list[str]) -> None:
        """Show these eyes."""
        self._props["eyes"] = eyes

    def show_aspect(self, ratio: float) -> None:
        """Set the aspect ratio of the pictures, width over height."""
        self._props["aspect"] = ratio
