"""Python interface of the compiled library of frames."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from estimator.native import Library, LibraryUnavailable, selected
from filter_service.errors import RenderFailed
from filter_service.native import records
from filter_service.native.functions import FUNCTIONS

PATH = Path(__file__).parent / "_loops.so"


class Loops(Library):
    """The library of `source/`; its loops run on the pool of `estimator.native`."""

    def __init__(self, path: Path, *, portable: bool = False):
        super().__init__(path, FUNCTIONS, records.SIZES, portable=portable)


@cache
def loops() -> Loops:
    """Return the compiled library, loaded once; see `estimator.native.selected`.

    Raises
    ------
    RenderFailed
        If it was not built or cannot be loaded; the message has the remedy.
    """
    try:
        path, portable = selected(PATH)
        return Loops(path, portable=portable)
    except LibraryUnavailable as error:
        raise RenderFailed(str(error)) from error
