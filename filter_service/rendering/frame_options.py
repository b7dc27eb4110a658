"""How one frame is to be filtered, checked."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.checked import checked
from filter_service.errors import BadMessage, CameraMismatch
from filter_service.psfs.store import PsfStore
from filter_service.rendering.gaze import usable_gaze
from filter_service.rgbd_view import RgbdView
from filter_service.settings import ACCUMULATIONS, OUTPUTS, RenderTolerance

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}


@dataclass(frozen=True)
class FrameOptions:
    """How a frame is filtered.

    Attributes
    ----------
    paper_rule : bool
        Fragments add up as the paper has it.
    merge : bool
    tolerance : float
        Of merging, of coarse kernels and of layers, against the usual; 0 is exact.
    output : str
        One of `OUTPUT_DTYPES`.
    gaze_deg : (h, v)
        As it is used.
    gaze_notes : tuple of str
        Where that is not what was asked for.
    """

    paper_rule: bool
    merge: bool
    tolerance: float
    output: str
    gaze_deg: tuple[float, float]
    gaze_notes: tuple[str, ...]

    @property
    def is_encoded(self) -> bool:
        """Whether the picture is encoded for a screen."""
        return self.output == "srgb8"


def frame_options(
    view: RgbdView,
    store: PsfStore,
    *,
    accumulation: str,
    merge: bool,
    render_tolerance: float,
    output: str,
    gaze_deg: tuple[float, float] | None,
) -> FrameOptions:
    """Check what a frame asks for against the store that shall serve it.

    Raises
    ------
    BadMessage
        A choice that there is not, a gaze that is no direction, or a tolerance out of
        range.
    CameraMismatch
        The store is for another camera, see `camera.is_same_camera`.
    """
    _check_choice("accumulation", accumulation, ACCUMULATIONS)
    _check_choice("output", output, OUTPUTS)
    if not store.spec.serves(view.camera):
        raise CameraMismatch(
            f"PSFs are for {store.spec.camera}, the view's is {view.camera}",
            field="tangents",
        )
    tolerance = checked(render_tolerance, RenderTolerance, "render_tolerance")
    used_deg, notes = usable_gaze(store.spec, gaze_deg)
    return FrameOptions(
        accumulation == "paper", merge, tolerance, output, used_deg, notes
    )


def picture_room(
    view: RgbdView, options: FrameOptions, out: NDArray[Any] | None
) -> NDArray[Any]:
    """Return where the picture of a view goes: the caller's memory, if there is some.

    Raises
    ------
    BadMessage
        It has another shape or type, or cannot be written from end to end.
    """
    shape, dtype = view.color.shape, np.dtype(OUTPUT_DTYPES[options.output])
    if out is None:
        return np.empty(shape, dtype)
    if out.shape != shape or out.dtype != dtype or not out.flags.carray:
        raise BadMessage(
            f"an array {out.shape} of {out.dtype}",
            field="out",
            allowed=f"{shape} of {dtype}, contiguous and writeable",
        )
    return out


def _check_choice(field: str, value: str, options: tuple[str, ...]) -> None:
    if value not in options:
        raise BadMessage(f"{value!r}", field=field, allowed=", ".join(options))
