"""Rendering of a scene for both eyes of a headset, in one OpenGL context."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np

from clients.headset.poses import matrix_of
from clients.headset.runtime import EyeView
from clients.headset.stereo_gaze import TexturePicture
from clients.scenes.geometry import Array
from clients.scenes.scene import Scene
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
        found = []
        for number, view in enumerate(views):
            pose = self._stand @ matrix_of(view.pose)
            image = self._view_of(size_px).draw(pose, view.tangents, image=number)
            found.append(TexturePicture(view, image))
        return tuple(found)

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
