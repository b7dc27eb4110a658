"""Render a scene's color and depth for one eye, in an OpenGL context of the caller.

It renders the scenes of `clients.scene_renderer` with the same look, without pyrender,
which requires a different PyOpenGL platform than the one that OpenXR selects.
"""

from typing import Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

from clients.headset.projection import Tangents, camera_uniforms
from clients.headset.scene_buffers import SceneBuffers
from clients.scenes.geometry import Array
from clients.scenes.scene import Scene

Picture = tuple[NDArray[np.uint8], NDArray[np.float32]]

_FRAMEBUFFER_SRGB = 0x8DB9  # GL_FRAMEBUFFER_SRGB
_WRITE, _KEEP = (True,) * 4, (False,) * 4


class SceneView:
    """View of one scene, in an OpenGL context that may be shared.

    Parameters
    ----------
    context : moderngl.Context
        Context to render in; OpenGL 3.3 or later.
    scene : Scene
    size_px : (width, height) of a picture
    supersampling : samples per pixel and axis

    Raises
    ------
    ValueError
        A size below 1 px, or larger than the context can render.

    Notes
    -----
    A pixel's color is the mean of its samples in linear light. Its depth is that of one
    sample, the second nearest of each four. A mean across an edge would be a depth at
    which there is no surface.

    Every call makes the context current. If moderngl obtained the context through EGL,
    no context is current afterward: other drawing in the same thread must be in a
    `with context:` of its own, which must not be open around a call.
    GL_FRAMEBUFFER_SRGB is left off.
    """

    def __init__(
        self,
        context: moderngl.Context,
        scene: Scene,
        size_px: tuple[int, int],
        *,
        supersampling: int = 2,
    ):
        width, height = size_px
        if min(width, height, supersampling) < 1:
            raise ValueError(f"size {width}x{height} px, {supersampling} samples: >= 1")
        self.scene, self.size_px = scene, size_px
        self._context = context
        with context:
            self._check_size(supersampling)
            self._held = SceneBuffers(context, scene, size_px, supersampling)

    def __enter__(self) -> "SceneView":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL objects; closing twice is allowed."""
        with self._context:
            self._held.release()

    def render(
        self, pose: Array, tangents: Tangents, *, out: Picture | None = None
    ) -> Picture:
        """Render the scene from a pose.

        Parameters
        ----------
        pose : (4, 4)
            Camera to world; x right, y up, looking along -z.
        tangents : (left, right, up, down) of the image edges
        out : (color, depth_m), optional
            Output arrays, contiguous, of the shapes and types below.

        Returns
        -------
        color : (h, w, 3) uint8 sRGB, top row first
        depth_m : (h, w) float32
            Planar depth; +inf for the background and from `scene.infinite_from_m` on.

        Raises
        ------
        ValueError
            The pose or tangents do not describe a camera, or an output array does not
            fit.
        """
        uniforms = camera_uniforms(pose, tangents, self.scene)
        color, depth_m = self._memory(out)
        with self._context:
            self._draw(uniforms)
            self._resolve()
            self._read_into(color, depth_m)
        return color, depth_m

    def _draw(self, uniforms: dict[str, tuple[float, ...]]) -> None:
        """Draw all samples."""
        held, samples = self._held, self._held.samples
        with self._context.scope(samples, moderngl.DEPTH_TEST):
            # Vertices hold sRGB values already. Code that draws to a headset may have
            # enabled the conversion.
            self._context.disable_direct(_FRAMEBUFFER_SRGB)
            samples.color_mask = cast("Any", (_WRITE, _KEEP))
            samples.clear(*self.scene.background_srgb, 1.0)
            samples.color_mask = cast("Any", (_KEEP, _WRITE))
            samples.clear()
            samples.color_mask = cast("Any", (_WRITE, _WRITE))
            for name, value in uniforms.items():
                cast("moderngl.Uniform", held.program[name]).value = value
            for triangles, texture in held.draw_calls:
                texture.use(0)
                triangles.render(moderngl.TRIANGLES)

    def _resolve(self) -> None:
        """Resolve samples to pixels."""
        with self._context.scope(self._held.pixels, moderngl.NOTHING):
            for unit, texture in enumerate(self._held.samples.color_attachments):
                cast("moderngl.Texture", texture).use(unit)
            self._held.resolving.render(moderngl.TRIANGLES, vertices=3)

    def _read_into(
        self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]
    ) -> None:
        """Copy the pixels to the output arrays; waits for the GPU."""
        pixels = self._held.pixels
        # The size of a row of three-byte pixels need not be a multiple of four.
        pixels.read_into(color, components=3, attachment=0, alignment=1)
        pixels.read_into(depth_m, components=1, attachment=1, dtype="f4")

    def _memory(self, out: Picture | None) -> Picture:
        """Return the caller's output arrays after a check, or new ones."""
        width, height = self.size_px
        wanted = (((height, width, 3), np.uint8), ((height, width), np.float32))
        if out is None:
            return cast(
                "Picture", tuple(np.empty(shape, dtype) for shape, dtype in wanted)
            )
        arrays: tuple[NDArray[Any], ...] = out
        for array, (shape, dtype) in zip(arrays, wanted, strict=True):
            fits = array.shape == shape and array.dtype == dtype
            if not (fits and array.flags.c_contiguous and array.flags.writeable):
                raise ValueError(
                    f"memory of {array.dtype} {array.shape}; needs {np.dtype(dtype)} "
                    f"{shape}, without gaps and writeable"
                )
        return out

    def _check_size(self, supersampling: int) -> None:
        info = self._context.info
        largest = min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"])
        if supersampling * max(self.size_px) > largest:
            width, height = self.size_px
            raise ValueError(
                f"{width}x{height} px with {supersampling} samples per axis; this "
                f"OpenGL renders up to {largest} samples along a side"
            )
