"""Drawing of images into the headset's images, with OpenGL."""

from pathlib import Path
from typing import Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import ShownView

NEAR_M = 0.05
"""Smaller depths are clamped to this one."""

_ASSETS = Path(__file__).resolve().parents[1] / "assets"


class Presenter:
    """Draws images of one size into framebuffers of the caller.

    Parameters
    ----------
    context : moderngl.Context
        Context to draw in, which must be current for every call.
    size_px : (int, int)
        Width and height of an image.
    """

    def __init__(self, context: moderngl.Context, size_px: tuple[int, int]) -> None:
        self._context = context
        self._size_px = size_px
        names = ("resolve.vert", "present.frag")
        vertex, fragment = ((_ASSETS / name).read_text("utf-8") for name in names)
        self._program = context.program(vertex_shader=vertex, fragment_shader=fragment)
        self._triangle = context.vertex_array(self._program, [])
        self._seen = context.texture(size_px, 3, alignment=1)
        self._plain = context.texture(size_px, 3, alignment=1)
        self._depth_m = context.texture(size_px, 1, dtype="f4")
        for unit, name in enumerate(("seen", "plain", "depth_m")):
            cast("moderngl.Uniform", self._program[name]).value = unit
        cast("moderngl.Uniform", self._program["near_m"]).value = NEAR_M
        cast("moderngl.Uniform", self._program["size_px"]).value = size_px

    def release(self) -> None:
        """Free the OpenGL objects."""
        for made in (
            *(self._triangle, self._program),
            *(self._seen, self._plain, self._depth_m),
        ):
            made.release()

    def draw(self, shown: ShownView, target: moderngl.Framebuffer) -> None:
        """Draw color and depth of a view into a framebuffer."""
        seen = _in_texture(shown.color, self._seen)
        depth_m = _in_texture(shown.depth_m, self._depth_m)
        ratio = 0.0 if shown.plain is None else shown.plain_ratio
        plain = self._plain
        if shown.plain is not None and ratio > 0.0:
            plain = _in_texture(shown.plain, self._plain)
        cast("moderngl.Uniform", self._program["plain_ratio"]).value = ratio
        context = self._context
        with context.scope(target, moderngl.DEPTH_TEST):
            context.depth_func = (
                "1"  # always pass: depth is written only if the test is on
            )
            for unit, texture in enumerate((seen, plain, depth_m)):
                texture.use(unit)
            target.viewport = (0, 0, *self._size_px)
            self._triangle.render(moderngl.TRIANGLES, vertices=3)
            context.depth_func = "<"


def _in_texture(
    image: NDArray[Any] | moderngl.Texture, own: moderngl.Texture
) -> moderngl.Texture:
    """Return an image's texture; an array is copied to the presenter's own."""
    if not isinstance(image, np.ndarray):
        return image
    own.write(np.ascontiguousarray(image), alignment=1)
    return own
