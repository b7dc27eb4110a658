"""OpenGL objects of a scene view: render targets, programs and triangles."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import moderngl
import numpy as np
from numpy.typing import DTypeLike, NDArray

from clients.scenes.scene import Batch, Scene

LEAST_GAP_DPT = 0.05
"""Smallest distance of the hidden layer behind the visible surface; closer surfaces
have nearly the same blur."""

_Made = TypeVar("_Made")

_ASSETS = Path(__file__).resolve().parents[1] / "assets"
_SRGB8_ALPHA8 = 0x8C43  # GL_SRGB8_ALPHA8

_RESOLVE_CONSTANTS = {
    # Bits of the float: a division by zero need not give infinity.
    "INFINITY_BITS": "0x7F800000u",
    # IEC 61966-2-1, as in `clients.scenes.geometry`.
    "SRGB_GAIN": 1.055,
    "SRGB_POWER": 2.4,
    "SRGB_SLOPE": 12.92,
    "SRGB_KNEE": 0.0031308,
}


class Layer(NamedTuple):
    """OpenGL objects that render one layer, visible or hidden.

    Attributes
    ----------
    samples : moderngl.Framebuffer
        Target of the samples: color, and the inverse of planar depth as a float, 1/m.
        A depth buffer is too coarse at large distances.
    program : moderngl.Program
        Draws the scene.
    draw_calls : list of (moderngl.VertexArray, moderngl.Texture)
        Triangles of the program, each with its texture.
    resolving : moderngl.VertexArray
        One triangle that resolves samples to pixels.
    """

    samples: moderngl.Framebuffer
    program: moderngl.Program
    draw_calls: list[tuple[moderngl.VertexArray, moderngl.Texture]]
    resolving: moderngl.VertexArray


class SceneBuffers:
    """OpenGL objects of one view; their context must be current for every call.

    Parameters
    ----------
    context : moderngl.Context
        Context that owns the objects.
    scene : Scene
        Scene to upload.
    size_px : (int, int)
        Width and height of an image.
    supersampling : int
        Samples per pixel along each axis.
    image_count : int
        Number of targets of the pixels.

    Attributes
    ----------
    images : list of moderngl.Framebuffer
        Targets of the pixels resolved from samples: color, and planar depth in meters,
        with the top row first.
    visible, hidden : Layer
        Objects of each layer; those of the hidden layer are created at first use.
    """

    def __init__(
        self,
        context: moderngl.Context,
        scene: Scene,
        size_px: tuple[int, int],
        supersampling: int,
        image_count: int,
    ):
        self._context, self._scene = context, scene
        self._size_px, self._supersampling = size_px, supersampling
        self._owned: list[Any] = []
        try:
            self.images = [
                self._target(size_px, None, with_depth=False)
                for _ in range(image_count)
            ]
            self._content = self._uploaded(scene)
            self.visible = self._layer({})
        except BaseException:
            self.release()
            raise

    @cached_property
    def hidden(self) -> Layer:
        """Objects that render the hidden layer."""
        return self._layer({"LEAST_GAP_DPT": LEAST_GAP_DPT})

    def release(self) -> None:
        """Free all objects."""
        while self._owned:
            self._owned.pop().release()

    def _own(self, made: _Made) -> _Made:
        """Register an object for release and return it."""
        self._owned.append(made)
        return made

    def _layer(self, defines: Mapping[str, object]) -> Layer:
        width_px, height_px = self._size_px
        samples_px = (self._supersampling * width_px, self._supersampling * height_px)
        # Samples hold sRGB values, which OpenGL decodes to linear light on reading:
        # faster than a power law in the shader.
        samples = self._target(samples_px, _SRGB8_ALPHA8, with_depth=True)
        program: Any = self._program("scene.vert", "scene.frag", defines)
        program["surface"].value = 0
        calls = [
            (self._own(self._context.vertex_array(program, *content)), texture)
            for content, texture in self._content
        ]
        constants = {"SAMPLES": self._supersampling, **_RESOLVE_CONSTANTS, **defines}
        resolving: Any = self._program("resolve.vert", "resolve.frag", constants)
        resolving["samples_light"].value, resolving["samples_per_m"].value = 0, 1
        resolving["infinite_to_per_m"].value = 1.0 / self._scene.infinite_from_m
        resolving["last_row"].value = height_px - 1
        if defines:
            program["seen_per_m"].value, resolving["seen_per_m"].value = 1, 2
        triangle = self._own(self._context.vertex_array(resolving, []))
        return Layer(samples, program, calls, triangle)

    def _target(
        self, size_px: tuple[int, int], color_format: int | None, *, with_depth: bool
    ) -> moderngl.Framebuffer:
        """Return a framebuffer for a color and a float."""
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

    def _uploaded(self, scene: Scene) -> list[tuple[tuple[Any, ...], moderngl.Texture]]:
        """Return each batch's vertices, indices and texture.

        Batches may share a texture.
        """
        # A surface without a texture is its color times white.
        textures: dict[int | None, moderngl.Texture] = {
            None: self._own(self._context.texture((1, 1), 3, b"\xff" * 3))
        }
        found = []
        for batch in scene.batches:
            key = None if batch.texture is None else id(batch.texture)
            if key not in textures:
                assert batch.texture is not None
                textures[key] = self._surface(batch.texture)
            found.append((self._triangles(batch), textures[key]))
        return found

    def _triangles(self, batch: Batch) -> tuple[list[tuple[Any, str, str]], Any]:
        """Return a batch's vertices and indices in the layout of the scene shader."""
        columns = (
            (batch.vertices_m, "3f", "vertex_m"),
            (batch.srgb, "3f", "srgb"),
            (batch.uv, "2f", "uv"),
        )
        content = [
            (self._buffer(values, np.float32), kind, name)
            for values, kind, name in columns
        ]
        return content, self._buffer(batch.faces, np.uint32)

    def _buffer(self, values: NDArray[Any], dtype: DTypeLike) -> moderngl.Buffer:
        return self._own(self._context.buffer(np.ascontiguousarray(values, dtype)))

    def _surface(self, texels: NDArray[np.uint8]) -> moderngl.Texture:
        """Return a repeating texture with mipmaps and linear filtering."""
        height, width = texels.shape[:2]
        upright = np.ascontiguousarray(texels[::-1])
        texture = self._own(self._context.texture((width, height), 3, upright))
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return texture
