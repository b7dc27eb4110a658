"""Rendering of a scene for both eyes of a headset, in one OpenGL context."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import EyeView, ShownView, matrix_of
from clients.headset.stereo_gaze import TexturePicture
from clients.scene_renderer import PATHS, path_moments
from clients.scenes.geometry import Array, Scene
from clients.scenes.scene_view import SceneView

N_EYES = 2


class SceneScenery:
    """Renderer of a scene for both eyes.

    Parameters
    ----------
    context : moderngl.Context
        Context to render in; see `SceneView`.
    scene : Scene
        Scene to render.
    stand : (4, 4) array
        Pose of the room's origin, at eye height, in the scene.
    supersampling : int
        Samples per pixel along each axis.
    """

    def __init__(
        self,
        context: moderngl.Context,
        scene: Scene,
        stand: Array,
        *,
        supersampling: int = 2,
    ) -> None:
        self._context, self._scene = context, scene
        self._stand = np.asarray(stand, float)
        self._supersampling = supersampling
        self._view: SceneView | None = None

    def pictures(
        self, views: Sequence[EyeView], size_px: tuple[int, int]
    ) -> tuple[TexturePicture, ...]:
        """Render the image of each eye; the next call overwrites the images."""
        images = [
            self._view_of(size_px).draw(
                self._stand @ matrix_of(view.pose), view.tangents, image=number
            )
            for number, view in enumerate(views)
        ]
        return tuple(map(TexturePicture, views, images))

    def _view_of(self, size_px: tuple[int, int]) -> SceneView:
        if self._view is None or self._view.size_px != size_px:
            self.close()
            self._view = SceneView(
                self._context,
                self._scene,
                size_px,
                supersampling=self._supersampling,
                image_count=N_EYES,
            )
        return self._view

    def close(self) -> None:
        """Free the OpenGL objects."""
        if self._view is not None:
            self._view.close()
            self._view = None


# Images in the headset

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
        vertex = (_ASSETS / "resolve.vert").read_text("utf-8")
        fragment = (_ASSETS / "present.frag").read_text("utf-8")
        program: Any = context.program(vertex_shader=vertex, fragment_shader=fragment)
        self._program = program
        self._triangle = context.vertex_array(program, [])
        self._seen = context.texture(size_px, 3, alignment=1)
        self._plain = context.texture(size_px, 3, alignment=1)
        self._depth_m = context.texture(size_px, 1, dtype="f4")
        for unit, name in enumerate(("seen", "plain", "depth_m")):
            program[name].value = unit
        program["near_m"].value = NEAR_M
        program["size_px"].value = size_px

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
        plain, ratio = self._plain, 0.0
        if shown.plain is not None and shown.plain_ratio > 0.0:
            plain = _in_texture(shown.plain, self._plain)
            ratio = shown.plain_ratio
        self._program["plain_ratio"].value = ratio
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


# Position of the viewer

EYE_HEIGHT_M = 1.6
_FLOOR_M = 0.3
"""A scene whose lowest point is at most this far from 0 has its floor at 0."""

_HEADROOM_M = 0.1
_STEP_BACK_RATIO = 0.25
"""Distance from the near end of an interior, as a fraction of its depth."""

_LEAST_DISTANCE_M = 0.4
_DISTANCE_RADII = 2.2
"""Distance in radii of the scene's bounding sphere, which is then 54 degrees wide."""


def viewpoint(scene: Scene) -> Array:
    """Return the pose (4, 4), camera to world, of an upright viewer.

    In a built-in scene, the viewer stands at the beginning of the scene's path. A scene
    that has its floor at 0 and is taller than a person is an interior; the viewer
    stands inside, with eyes `EYE_HEIGHT_M` above the floor. Any other scene is viewed
    from outside, along -z, at the height of its center.
    """
    if scene.name in PATHS:
        return path_moments(PATHS[scene.name], 1)[0].pose
    points_m = [batch.vertices_m[batch.faces].reshape(-1, 3) for batch in scene.batches]
    low_m = np.min([points.min(axis=0) for points in points_m], axis=0)
    high_m = np.max([points.max(axis=0) for points in points_m], axis=0)
    pose = np.eye(4)
    pose[:3, 3] = (low_m + high_m) / 2.0
    if abs(low_m[1]) <= _FLOOR_M and high_m[1] >= EYE_HEIGHT_M + _HEADROOM_M:
        pose[1, 3] = EYE_HEIGHT_M
        pose[2, 3] = high_m[2] - _STEP_BACK_RATIO * (high_m[2] - low_m[2])
    else:
        radius_m = np.linalg.norm(high_m - low_m) / 2.0
        pose[2, 3] += max(_DISTANCE_RADII * radius_m, _LEAST_DISTANCE_M)
    return pose
