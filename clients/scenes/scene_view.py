"""Rendering of a scene's color and depth in an OpenGL context of the caller.

The renderers of this project all draw with `SceneView`: `clients.scene_renderer` for
streams, `clients.headset.scenery` for both eyes of a headset, and
`clients.scenes.appearance` for shadow maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import moderngl
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clients.scenes.geometry import Array, Scene, linear_from_srgb
from filter_service.errors import RenderFailed

Tangents = tuple[float, float, float, float]
Picture = tuple[NDArray[Any], NDArray[np.float32]]
"""Color, sRGB bytes or linear floats, and depth."""

_FRAMEBUFFER_SRGB = 0x8DB9  # GL_FRAMEBUFFER_SRGB
_WRITE, _KEEP = (True,) * 4, (False,) * 4
LEAST_GAP_DPT = 0.05
"""Smallest distance of the hidden layer behind the visible surface; closer surfaces
have nearly the same blur."""

_Made = TypeVar("_Made")

_ASSETS = Path(__file__).resolve().parents[1] / "assets"
_SRGB8_ALPHA8 = 0x8C43  # GL_SRGB8_ALPHA8

_INFINITY_BITS = "0x7F800000u"
"""Bits of the float: a division by zero need not give infinity."""

_SRGB_CONSTANTS: dict[str, object] = {
    # IEC 61966-2-1, as in `clients.scenes.geometry`.
    "SRGB_GAIN": 1.055,
    "SRGB_POWER": 2.4,
    "SRGB_SLOPE": 12.92,
    "SRGB_KNEE": 0.0031308,
}


def open_context(version: int = 330) -> moderngl.Context:
    """Open an OpenGL context through EGL, without a window; it is not current.

    Parameters
    ----------
    version : int
        Least OpenGL version, such as 330 for 3.3.

    Raises
    ------
    RenderFailed
        If this machine offers no such context.
    """
    try:
        context = moderngl.create_context(
            standalone=True, backend=cast("Any", "egl"), require=version
        )
    except Exception as error:  # moderngl raises no narrower type
        raise RenderFailed(
            f"scenes require OpenGL {version / 100:.1f} through EGL: {error}; run "
            "'ocufilter doctor' to see what is missing"
        ) from error
    # A new EGL context is current; leaving the block releases it.
    with context:
        return context


class SceneImage:
    """A rendered image in textures, with the top row first.

    Attributes
    ----------
    color : moderngl.Texture
        RGBA8 with sRGB values, or RGBA32F with linear light.
    depth_m : moderngl.Texture
        Planar depth, R32F; +inf for the background.
    """

    def __init__(
        self,
        context: moderngl.Context,
        color: moderngl.Texture,
        depth_m: moderngl.Texture,
    ) -> None:
        self._context, self.color, self.depth_m = context, color, depth_m

    def read(self) -> Picture:
        """Wait for the image and return it as arrays, as `SceneView.render` does."""
        with self._context:
            return read_texture(self.color)[..., :3], read_texture(self.depth_m)


def read_texture(texture: moderngl.Texture) -> NDArray[Any]:
    """Return the pixels of a texture, first row first; its context is current."""
    width, height = texture.size
    dtype = np.float32 if texture.dtype == "f4" else np.uint8
    shape = (height, width, texture.components)[: 2 + (texture.components > 1)]
    found = np.empty(shape, dtype)
    texture.read_into(found, alignment=1)
    return found


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


class SceneView:
    """Renderer of one scene, in an OpenGL context that may be shared.

    Parameters
    ----------
    context : moderngl.Context
        Context to render in; OpenGL 3.3 or later.
    scene : Scene
        Scene to render.
    size_px : (int, int)
        Width and height of an image.
    supersampling : int
        Samples per pixel along each axis.
    image_count : int
        Number of images that `draw` can keep at a time.
    is_linear : bool
        Whether colors are linear light in float32, which may exceed 1, instead of sRGB
        bytes.

    Raises
    ------
    ValueError
        If a size is below 1 px or larger than the context can render.

    Notes
    -----
    A pixel's color is the mean of its samples in linear light.  Its depth is the
    depth of one sample, a quarter of the way from the nearest to the farthest.  The
    mean across an edge would be a depth without a surface.

    Every call makes the context current.  If moderngl obtained the context through EGL,
    no context is current afterward: other drawing in the same thread must be in a
    separate ``with context:`` block, which must not be open around a call.
    Calls leave GL_FRAMEBUFFER_SRGB disabled.
    """

    def __init__(
        self,
        context: moderngl.Context,
        scene: Scene,
        size_px: tuple[int, int],
        *,
        supersampling: int = 2,
        image_count: int = 1,
        is_linear: bool = False,
    ):
        self.scene, self.size_px, self.is_linear = scene, size_px, is_linear
        self._context, self._supersampling = context, supersampling
        self._owned: list[Any] = []
        try:
            with context:
                info = context.info
                check_size(
                    size_px,
                    supersampling,
                    min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"]),
                )
                # Color, and planar depth in meters, with the top row first.
                self._images = [
                    self._target(size_px, None, with_depth=False)
                    for _ in range(image_count)
                ]
                self._content = self._uploaded(scene)
                self._visible = self._layer({})
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> SceneView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL objects; closing twice is allowed."""
        with self._context:
            while self._owned:
                self._owned.pop().release()

    def render(self, pose: Array, tangents: Tangents) -> Picture:
        """Render the scene from a pose.

        Parameters
        ----------
        pose : (4, 4) array
            Camera to world; x right, y up, looking along -z.
        tangents : (left, right, up, down)
            Tangents of the angles to the image edges.

        Returns
        -------
        color : (h, w, 3) uint8 or float32
            sRGB, or linear light if the view is linear; top row first.
        depth_m : (h, w) float32
            Planar depth; +inf for the background and from `scene.infinite_from_m` on.

        Raises
        ------
        ValueError
            If the pose or the tangents do not describe a camera.
        """
        uniforms = self._uniforms(pose, tangents)
        with self._context:
            self._draw(self._visible, uniforms)
            return self._resolved(self._visible)

    def draw(self, pose: Array, tangents: Tangents, *, image: int = 0) -> SceneImage:
        """Render the scene from a pose to textures, without waiting for the GPU.

        Parameters
        ----------
        pose, tangents
            As for `render`.
        image : int
            Number of the image, whose previous content is lost.
        """
        uniforms = self._uniforms(pose, tangents)
        target = self._images[image]
        with self._context:
            self._draw(self._visible, uniforms)
            self._resolve_to(target, self._visible)
        color, depth_m = target.color_attachments
        return SceneImage(
            self._context,
            cast("moderngl.Texture", color),
            cast("moderngl.Texture", depth_m),
        )

    def render_layers(self, pose: Array, tangents: Tangents) -> tuple[Picture, Picture]:
        """Render the visible surface and the hidden layer behind it.

        The scene is rendered a second time, without every fragment less than
        `LEAST_GAP_DPT` behind the visible surface (depth peeling).  The hidden color is
        the mean of the pixel's samples that have a hidden surface.

        Parameters
        ----------
        pose, tangents
            As for `render`.

        Returns
        -------
        visible, hidden : (color, depth_m)
            As for `render`; the hidden depth is 0 where nothing is hidden.
        """
        uniforms = self._uniforms(pose, tangents)
        with self._context:
            self._draw(self._visible, uniforms)
            visible = self._resolved(self._visible)
            seen = self._visible.samples.color_attachments[1]
            self._draw(self._hidden, uniforms, seen)
            return visible, self._resolved(self._hidden, seen)

    def parallel_depth_m(self, pose: Array, half_width_m: float) -> NDArray[np.float32]:
        """Return the depth (h, w) of front faces along parallel rays.

        Depth is +inf for the background.

        Parameters
        ----------
        pose : (4, 4) array
            Camera to world.
        half_width_m : float
            Half the width and height of the bundle of rays.
        """
        near_m, far_m = self.scene.near_m, self.scene.far_m
        clip_from_view = np.diag([1.0 / half_width_m] * 2 + [2 / (near_m - far_m), 1.0])
        clip_from_view[2, 3] = (near_m + far_m) / (near_m - far_m)
        uniforms = _uniforms(pose, clip_from_view)
        with self._context:
            self._draw(self._visible, uniforms, culls=True)
            return self._resolved(self._visible)[1]

    def _uniforms(
        self, pose: Array, tangents: Tangents
    ) -> dict[str, tuple[float, ...]]:
        return _uniforms(
            pose, projection(tangents, self.scene.near_m, self.scene.far_m)
        )

    def _draw(
        self,
        layer: Layer,
        uniforms: dict[str, tuple[float, ...]],
        seen: Any = None,
        *,
        culls: bool = False,
    ) -> None:
        """Draw all samples of a layer.

        Parameters
        ----------
        seen : moderngl.Texture, optional
            Samples of the visible depth, for the hidden layer.
        culls : bool
            Whether to leave out back faces.
        """
        samples = layer.samples
        flags = moderngl.DEPTH_TEST | (moderngl.CULL_FACE if culls else 0)
        with self._context.scope(samples, flags):
            # Vertices hold sRGB values already.  Code that draws to a headset may have
            # enabled the conversion.
            self._context.disable_direct(_FRAMEBUFFER_SRGB)
            samples.color_mask = cast("Any", (_WRITE, _KEEP))
            samples.clear(*self._background, 1.0)
            samples.color_mask = cast("Any", (_KEEP, _WRITE))
            samples.clear()
            samples.color_mask = cast("Any", (_WRITE, _WRITE))
            for name, value in uniforms.items():
                cast("moderngl.Uniform", layer.program[name]).value = value
            if seen is not None:
                seen.use(1)
            for triangles, texture in layer.draw_calls:
                texture.use(0)
                triangles.render(moderngl.TRIANGLES)

    def _resolved(self, layer: Layer, seen: Any = None) -> Picture:
        """Resolve samples to pixels and return these; waits for the GPU."""
        pixels, (width, height) = self._images[0], self.size_px
        self._resolve_to(pixels, layer, seen)
        dtype = np.float32 if self.is_linear else np.uint8
        color = np.empty((height, width, 3), dtype)
        depth_m = np.empty((height, width), np.float32)
        # The size of a row of three-byte pixels need not be a multiple of four.
        pixels.read_into(
            color,
            components=3,
            attachment=0,
            alignment=1,
            dtype="f4" if self.is_linear else "f1",
        )
        pixels.read_into(depth_m, components=1, attachment=1, dtype="f4")
        return color, depth_m

    def _resolve_to(
        self, pixels: moderngl.Framebuffer, layer: Layer, seen: Any = None
    ) -> None:
        """Resolve samples to pixels."""
        with self._context.scope(pixels, moderngl.NOTHING):
            for unit, texture in enumerate((*layer.samples.color_attachments, seen)):
                if texture is not None:
                    cast("moderngl.Texture", texture).use(unit)
            layer.resolving.render(moderngl.TRIANGLES, vertices=3)

    @property
    def _background(self) -> tuple[float, float, float]:
        if not self.is_linear:
            return self.scene.background_srgb
        red, green, blue = linear_from_srgb(np.array(self.scene.background_srgb))
        return float(red), float(green), float(blue)

    @cached_property
    def _hidden(self) -> Layer:
        """Objects that render the hidden layer, created at first use."""
        return self._layer({"LEAST_GAP_DPT": LEAST_GAP_DPT})

    def _own(self, made: _Made) -> _Made:
        """Register an object for release and return it."""
        self._owned.append(made)
        return made

    def _layer(self, defines: Mapping[str, object]) -> Layer:
        width_px, height_px = self.size_px
        samples_px = (self._supersampling * width_px, self._supersampling * height_px)
        # Samples hold sRGB values, which OpenGL decodes to linear light on reading:
        # faster than a power law in the shader.
        samples = self._target(samples_px, _SRGB8_ALPHA8, with_depth=True)
        constants = {**_SRGB_CONSTANTS, **defines}
        if self.is_linear:
            constants["LINEAR"] = 1
        program: Any = self._program("scene.vert", "scene.frag", constants)
        program["surface"].value = 0
        calls = [
            (self._own(self._context.vertex_array(program, *content)), texture)
            for content, texture in self._content
        ]
        constants |= {"SAMPLES": self._supersampling, "INFINITY_BITS": _INFINITY_BITS}
        resolving: Any = self._program("resolve.vert", "resolve.frag", constants)
        resolving["samples_light"].value, resolving["samples_per_m"].value = 0, 1
        resolving["infinite_to_per_m"].value = 1.0 / self.scene.infinite_from_m
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
        if self.is_linear:
            color = own(context.texture(size_px, 4, dtype="f4"))
        else:
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
            if batch.texture is not None and key not in textures:
                textures[key] = self._surface(batch.texture)
            vertices = [
                (self._buffer(batch.vertices_m, np.float32), "3f", "vertex_m"),
                (self._buffer(batch.srgb, np.float32), "3f", "srgb"),
                (self._buffer(batch.uv, np.float32), "2f", "uv"),
            ]
            content = vertices, self._buffer(batch.faces, np.uint32)
            found.append((content, textures[key]))
        return found

    def _buffer(self, values: NDArray[Any], dtype: DTypeLike) -> moderngl.Buffer:
        return self._own(self._context.buffer(np.ascontiguousarray(values, dtype)))

    def _surface(self, texels: NDArray[np.uint8]) -> moderngl.Texture:
        """Return a repeating texture with mipmaps and linear filtering."""
        upright = np.ascontiguousarray(texels[::-1])
        texture = self._own(self._context.texture(texels.shape[1::-1], 3, upright))
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return texture


def check_size(size_px: tuple[int, int], supersampling: int, largest: int) -> None:
    """Refuse images without pixels and those with more than OpenGL can render.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of an image.
    supersampling : int
        Samples per pixel along each axis.
    largest : int
        Most samples along a side.

    Raises
    ------
    ValueError
    """
    width, height = size_px
    if min(width, height, supersampling) < 1:
        raise ValueError(
            f"size_px is {width}x{height} and supersampling {supersampling}; "
            "allowed: 1 or more each"
        )
    if supersampling * max(size_px) > largest:
        raise ValueError(
            f"{width}x{height} px with {supersampling} samples per axis; this "
            f"OpenGL renders up to {largest} samples along a side"
        )


def check_pose(pose: ArrayLike) -> Array:
    """Return a camera's pose (4, 4) as an array.

    Raises
    ------
    ValueError
        If the pose does not describe a camera.
    """
    pose = np.asarray(pose, float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose of shape {pose.shape}; expected 4x4 finite numbers")
    turned = pose[:3, :3].T @ pose[:3, :3]
    if not np.allclose(turned, np.eye(3), atol=1e-3):
        raise ValueError("pose is not rigid; its axes must be orthogonal unit vectors")
    return pose


def _uniforms(pose: Array, clip_from_view: Array) -> dict[str, tuple[float, ...]]:
    """Return the camera's uniforms of the scene shader, by name."""
    pose = check_pose(pose)
    view_from_world = np.linalg.inv(pose)
    # GLSL matrices are column-major.
    clip_from_world = (clip_from_view @ view_from_world).T
    return {
        "clip_from_world": tuple(clip_from_world.ravel()),
        "planar_depth": tuple(-view_from_world[2]),
    }


def projection(tangents: Tangents, near_m: float, far_m: float) -> Array:
    """Return OpenGL's projection matrix (4, 4) for an asymmetric frustum.

    Parameters
    ----------
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges.
    near_m, far_m : float
        Distances of the near and the far plane.

    Raises
    ------
    ValueError
        If tangents are not finite, or not left < right and down < up.
    """
    left, right, up, down = tangents
    if not (np.isfinite(tangents).all() and left < right and down < up):
        raise ValueError(
            f"tangents are {tangents}; allowed: finite, left < right and down < up"
        )
    width, height, depth_m = right - left, up - down, near_m - far_m
    return np.array(
        [
            [2 / width, 0.0, (right + left) / width, 0.0],
            [0.0, 2 / height, (up + down) / height, 0.0],
            [0.0, 0.0, (near_m + far_m) / depth_m, 2 * near_m * far_m / depth_m],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )
