"""Checked options of one frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage, CameraMismatch
from filter_service.psfs.store import PsfStore
from filter_service.rendering.gaze import usable_gaze
from filter_service.rgbd_view import RgbdView
from filter_service.settings import ACCUMULATIONS, OUTPUTS, RenderTolerance
from filter_service.validation import checked

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}


@dataclass(frozen=True)
class FrameOptions:
    """Options of a frame.

    Attributes
    ----------
    paper_rule : bool
        Whether fragments are accumulated by the paper's rule.
    merge : bool
    tolerance : float
        Errors of merging, coarse kernels and layers relative to the default; 0 is
        exact.
    output : str
        One of `OUTPUT_DTYPES`.
    gaze_deg : (h, v)
        As used.
    gaze_notes : tuple of str
        Notes if it differs from the requested gaze.
    """

    paper_rule: bool
    merge: bool
    tolerance: float
    output: str
    gaze_deg: tuple[float, float]
    gaze_notes: tuple[str, ...]

    @property
    def is_encoded(self) -> bool:
        """Whether the output image is encoded for a display."""
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
    """Check the options of a frame against its PSF store.

    Raises
    ------
    BadMessage
        Unknown choice, invalid gaze, or tolerance out of range.
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
    """Return the output array of a view: the caller's, or a new one.

    Raises
    ------
    BadMessage
        The array has another shape or type, or is not contiguous and writeable.
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
