"""Checks of a request against the PSF store that it names."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage, CameraMismatch
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gaze import usable_gaze
from filter_service.settings import Output, RenderOptions
from filter_service.validation import checked

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}


def check_request(
    request: ViewRequest, store: PsfStore
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Check a request; return the gaze to use, with notes if it differs.

    Raises
    ------
    BadMessage
        Unknown choice, invalid gaze, or tolerance out of range.
    CameraMismatch
        The store is for another camera, see `camera.is_same_camera`.
    """
    output: Any = Output  # mypy takes only classes for types as arguments
    checked(request.output, output, "output")
    checked(request.options.fields(), RenderOptions)
    if not store.spec.serves(request.view.camera):
        raise CameraMismatch(
            f"PSFs are for {store.spec.camera}, the view's is {request.view.camera}",
            field="tangents",
        )
    return usable_gaze(store.spec, request.gaze_deg)


def output_array(request: ViewRequest) -> NDArray[Any]:
    """Return the output array of a view: the caller's, or a new one.

    Raises
    ------
    BadMessage
        The array has another shape or type, or is not contiguous and writeable.
    """
    shape, dtype = request.view.color.shape, np.dtype(OUTPUT_DTYPES[request.output])
    out = request.out
    if out is None:
        return np.empty(shape, dtype)
    if out.shape != shape or out.dtype != dtype or not out.flags.carray:
        raise BadMessage(
            f"an array {out.shape} of {out.dtype}",
            field="out",
            allowed=f"{shape} of {dtype}, contiguous and writeable",
        )
    return out
