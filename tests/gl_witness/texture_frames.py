"""Frames in textures of the current context, by `EyeFilter`."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from filter_service import EyeFilter
from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rgbd_view import RgbdView
from tests.gl_witness.frames import FOCUS_DPT, PUPIL_MM, TIMES
from tests.numerical.gl_textures import SETS, ViewTextures, arrays_of

EYE, SCENE = "myopia", "courtyard"
SETTINGS = {"mode": "dynamic", "tolerance": "loose"}
STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}


def _name(formats: tuple) -> str:
    color, depth, target = (
        name if layer is None else f"{name}[{layer}]" for name, layer in formats
    )
    return f"{SCENE}, {EYE}, {color} and {depth} to {target}"


def _view(views: dict[str, RgbdView]) -> RgbdView:
    return replace(views[SCENE], hidden_color=None, hidden_depth_m=None)


def _of_arrays(eye: EyeFilter, view: RgbdView, formats: tuple) -> NDArray:
    """The frame of arrays that hold what the textures do."""
    output = "linear16" if formats[2][0] == "rgba16f" else "srgb8"
    return eye.filter(arrays_of(view, formats), output=output, **STATE).color


def filter_arrays(views: dict[str, RgbdView], engine: str) -> dict[str, NDArray]:
    """The frame of arrays, by the name of each set of textures."""
    view = _view(views)
    with EyeFilter(EYE, view.camera, SETTINGS, engine=engine) as eye:
        return {_name(formats): _of_arrays(eye, view, formats) for formats in SETS}


def filter_textures(
    views: dict[str, RgbdView],
) -> tuple[dict[str, NDArray], dict[str, int], set[tuple]]:
    """The frame in each set of textures of the current context.

    Returns
    -------
    pictures : dict
    steps : dict
        Largest difference from the frame of arrays, in steps of 8-bit sRGB.
    programs : set
        Keys of the passes that were compiled.
    """
    view, pictures, steps = _view(views), {}, {}
    with EyeFilter(EYE, view.camera, SETTINGS, gl_context="current") as eye:
        eye.wait()
        for formats in SETS:
            textures = ViewTextures(view, formats)
            for _ in range(TIMES):
                eye.filter_textures(textures.view, textures.target, **STATE)
            picture = textures.image()
            textures.delete()
            pictures[_name(formats)] = picture
            expected = _of_arrays(eye, view, formats)
            difference = _encoded(picture) - _encoded(expected)
            steps[_name(formats)] = int(np.abs(difference).max())
        programs = set(eye.builder.engine._gpu.passes.programs)
    return pictures, steps, programs


def _encoded(picture: NDArray) -> NDArray[np.int64]:
    if picture.dtype != np.uint8:
        picture = srgb_from_linear(picture)
    return picture.astype(np.int64)
