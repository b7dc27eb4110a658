"""OpenGL objects of a scene view: render targets, programs and triangles."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import moderngl
import numpy as np
from numpy.typing import DTypeLike, NDArray

from clients.scenes.scene import Batch, Scene

_Made = TypeVar("_Made")

_ASSETS = Path(__file__).resolve().parents[1] / "assets"
_SRGB8_ALPHA8 = 0x8C43  # GL_SRGB8_ALPHA8

_RESOLVE_CONSTANTS = {
    # the float with these bits; a division by zero need not give infinity
    "INFINITY_BITS": "0x7F800000u",
    # IEC 61966-2-1, as in `clients.scenes.geometry`
    "SRGB_GAIN": 1.055,
    "SRGB_POWER": 2.4,
    "SRGB_SLOPE": 12.92,
    "SRGB_KNEE": 0.0031308,
}


class SceneBuffers:
    """OpenGL objects of one view; their context must be current for every call.

    Parameters
    ----------
    size_px : (width, height) of a picture
    supersampling : samples per pixel and axis

    Attributes
    ----------
    samples, pixels : moderngl.Framebuffer
        Targets of the samples and of the pixels resolved from them: color, then a float
        for depth, 1/m for samples and m for pixels. A depth buffer is too coarse far
        away.
    program : moderngl.Program
        Draws the scene.
    draw_calls : list of (moderngl.VertexArray, moderngl.Texture)
    resolving : moderngl.VertexArray
        One triangle that resolves samples to pixels.
    """

    def __init__(
        self,
        context: moderngl.Context,
        scene: Scene,
        size_px: tuple[int, int],
        supersampling: int,
    ):
        self._context = context
        self._owned: list[Any] = []
        try:
            samples_px = (supersampling * size_px[0], supersampling * size_px[1])
            # Samples hold sRGB values, which OpenGL decodes to linear light on reading:
            # faster than a power law in the shader.
            self.samples = self._target(samples_px, _SRGB8_ALPHA8, with_depth=True)
            self.pixels = self._target(size_px, None, with_depth=False)
            self.program = self._program("scene.vert", "scene.frag", {})
            self.draw_calls = self._all_draw_calls(scene)
            self.resolving = self._resolving(scene, size_px[1], supersampling)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Free everything."""
        while self._owned:
            self._owned.pop().release()

    def _own(self, made: _Made) -> _Made:
        """Register an object for release and return it."""
        self._owned.append(made)
        return made

    def _target(
        self, size_px: tuple[int, int], color_format: int | None, *, with_depth: bool
    ) -> moderngl.Framebuffer:
        """Return a framebuffer for color and a float."""
        context, own = self._context, self._own
        color = own(context.texture(size_px, 4, internal_format=color_format))
        values = own(context.texture(size_px, 1, dtype="f4"))
        for texture in (color, values):
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        depth = own(context.depth_renderbuffer(size_px)) if with_depth else None
        return own(context.framebuffer([color, values], depth))

    def _program(
        self, vertex: str, fragment: str, defines: Mapping[str, object]
    ) -> moderngl.Program:
        """Build the program of two files in assets/."""
        texts = [(_ASSETS / name).read_text("utf-8") for name in (vertex, fragment)]
        version, _, rest = texts[1].partition("\n")
        lines = [f"#define {key} {value}" for key, value in defines.items()]
        # Compiler messages then refer to the lines of the file.
        texts[1] = "\n".join([version, *lines, "#line 2", rest])
        return self._own(
            self._context.program(vertex_shader=texts[0], fragment_shader=texts[1])
        )

    def _resolving(
        self, scene: Scene, height_px: int, supersampling: int
    ) -> moderngl.VertexArray:
        count = supersampling**2
        defines: dict[str, object] = {
            "SAMPLES": supersampling,
            "COUNT": count,
            "RANK": count // 4,
        }
        defines |= _RESOLVE_CONSTANTS
        program: Any = self._program("resolve.vert", "resolve.frag", defines)
        program["samples_light"].value, program["samples_per_m"].value = 0, 1
        program["infinite_to_per_m"].value = 1.0 / scene.infinite_from_m
        program["last_row"].value = height_px - 1
        return self._own(self._context.vertex_array(program, []))

    def _all_draw_calls(
        self, scene: Scene
    ) -> list[tuple[moderngl.VertexArray, moderngl.Texture]]:
        """Return each batch's triangles and texture; batches may share a texture."""
        # A surface without a texture is its color times white.
        textures: dict[int | None, moderngl.Texture] = {
            None: self._own(self._context.texture((1, 1), 3, b"\xff" * 3))
        }
        calls = []
        for batch in scene.batches:
            key = None if batch.texture is None else id(batch.texture)
            if key not in textures:
                assert batch.texture is not None
                textures[key] = self._surface(batch.texture)
            calls.append((self._triangles(batch), textures[key]))
        return calls

    def _triangles(self, batch: Batch) -> moderngl.VertexArray:
        """Return a batch's vertices and indices in the program's layout."""
        columns = (
            (batch.vertices_m, "3f", "vertex_m"),
            (batch.srgb, "3f", "srgb"),
            (batch.uv, "2f", "uv"),
        )
        content = [
            (self._buffer(values, np.float32), kind, name)
            for values, kind, name in columns
        ]
        indices = self._buffer(batch.faces, np.uint32)
        return self._own(self._context.vertex_array(self.program, content, indices))

    def _buffer(self, values: NDArray[Any], dtype: DTypeLike) -> moderngl.Buffer:
        return self._own(self._context.buffer(np.ascontiguousarray(values, dtype)))

    def _surface(self, texels: NDArray[np.uint8]) -> moderngl.Texture:
        """Return a texture with mipmaps, filtered and repeated as in pyrender."""
        height, width = texels.shape[:2]
        upright = np.ascontiguousarray(texels[::-1])
        texture = self._own(self._context.texture((width, height), 3, upright))
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return texture
