"""Checks of a request against the PSF store that it names."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage, CameraMismatch
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import TextureRequest, ViewRequest
from filter_service.rendering.gaze import clamped_gaze
from filter_service.settings import Output, RenderOptions
from filter_service.validation import checked

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}


def check_request(
    request: ViewRequest, store: PsfStore
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Check a request; return the clamped gaze, and a note if it was changed.

    Raises
    ------
    BadMessage
        Unknown choice, invalid gaze, or tolerance out of range.
    CameraMismatch
        The store is for another camera, see `camera.is_same_camera`.
    """
    output: Any = Output  # mypy takes only classes for types as arguments
    checked(request.output, output, "output")
    return check_options(request, store)


def check_options(
    request: ViewRequest | TextureRequest, store: PsfStore
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Check the options and the camera of a view; return as `check_request`."""
    camera = request.view.camera
    checked(request.options.fields(), RenderOptions)
    if not store.spec.serves(camera):
        raise CameraMismatch(
            f"the PSFs are for {store.spec.camera}, the view has {camera}",
            field="tangents",
        )
    return clamped_gaze(store.spec, request.state.gaze_deg)


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
            f"it is {out.dtype} of shape {out.shape}",
            field="out",
            allowed=f"{dtype} of shape {shape}, contiguous and writeable",
        )
    return out
