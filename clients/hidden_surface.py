"""The surface behind the visible one, by depth peeling with pyrender.

A scene is rendered a second time with a shader that discards fragments less than
`LEAST_GAP_DPT` behind the first image.  pyrender has no hook for that, so its program
cache is replaced during the second rendering.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from OpenGL import GL

from clients.pyrender_setup import pyrender

LEAST_GAP_DPT = 0.05
"""A surface less far behind the visible one would look as sharp as that."""

_SHADER = Path(__file__).parent / "assets" / "hidden_surface.frag"
_UNIT = 15
"""Texture unit that pyrender does not use: it assigns units from 0."""


class HiddenSurface:
    """Renders what is behind a first image, in that image's context.

    Parameters
    ----------
    renderer : pyrender.OffscreenRenderer
    depth_range_m : near and far plane of its camera
    """

    def __init__(
        self,
        renderer: "pyrender.OffscreenRenderer",
        depth_range_m: tuple[float, float],
    ):
        self._renderer = renderer
        self._programs = _Programs(depth_range_m)

    def render(
        self, world: "pyrender.Scene", flags: int, seen_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return color (h, w, 3) and planar depth (h, w) of the hidden surface.

        Parameters
        ----------
        seen_m : (h, w)
            Depth of the first image, just rendered from the same pose; 0 for the empty
            background.

        Returns
        -------
        depth_m : 0 where nothing is hidden
        """
        seen_per_m = np.zeros_like(seen_m)
        np.divide(1.0, seen_m, out=seen_per_m, where=seen_m > 0)
        texture = _upload(seen_per_m[::-1])
        inner = self._renderer._renderer
        own, inner._program_cache = inner._program_cache, self._programs
        try:
            return self._renderer.render(world, flags)
        finally:
            inner._program_cache = own
            GL.glDeleteTextures([texture])

    def close(self) -> None:
        """Release the programs; the renderer's context must still exist."""
        self._renderer._platform.make_current()
        self._programs.clear()


def _upload(values: NDArray[np.float32]) -> int:
    """Bind values (h, w), bottom row first, as a new texture; return its id."""
    texture = GL.glGenTextures(1)
    GL.glActiveTexture(GL.GL_TEXTURE0 + _UNIT)
    GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
    for name in (GL.GL_TEXTURE_MIN_FILTER, GL.GL_TEXTURE_MAG_FILTER):
        GL.glTexParameteri(GL.GL_TEXTURE_2D, name, GL.GL_NEAREST)
    height, width = values.shape
    GL.glTexImage2D(
        *(GL.GL_TEXTURE_2D, 0, GL.GL_R32F, width, height, 0),
        *(GL.GL_RED, GL.GL_FLOAT, np.ascontiguousarray(values)),
    )
    GL.glActiveTexture(GL.GL_TEXTURE0)
    return texture


class _Programs(pyrender.shader_program.ShaderProgramCache):
    """pyrender's program cache with another fragment shader."""

    def __init__(self, depth_range_m: tuple[float, float]):
        super().__init__()
        self._depth_range_m = np.array(depth_range_m)

    def get_program(
        self, vertex_shader: str, fragment_shader: str, *others: Any, **options: Any
    ) -> Any:
        """Return the program of one kind of mesh, which sets its own uniforms."""
        program = super().get_program(vertex_shader, str(_SHADER), *others, **options)
        if "_bind" not in vars(program):
            bind = program._bind

            def bind_and_set() -> None:
                bind()
                program.set_uniform("seen_per_m", _UNIT)
                program.set_uniform("least_gap_dpt", LEAST_GAP_DPT)
                program.set_uniform("depth_range_m", self._depth_range_m)

            program._bind = bind_and_set
        return program
