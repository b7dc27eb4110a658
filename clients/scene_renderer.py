"""Render a scene's colour and depth off screen with pyrender, without a display."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.pyrender_setup import delete_renderer, pyrender, release_context
from clients.scenes.geometry import Array
from clients.scenes.paths import PATHS, Key, path_moments
from clients.scenes.scene import Scene

_FLAGS = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES


@dataclass(frozen=True)
class SceneFrame:
    """One RGB-D frame and the state of the eye that looks at it.

    Attributes
    ----------
    color : (h, w, 3) uint8 sRGB, top row first
    depth_m : (h, w) float32, planar depth; +inf is background
    tangents : left, right, up, down of the view
    pose : (4, 4), camera to world
    pupil_diameter_mm, focus_dpt : suggested state of the eye
    gaze_deg : (h, v), where it looks in the image; None is straight on
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    pose: Array
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None = None


class SceneRenderer:
    """An off-screen window onto one scene.

    Parameters
    ----------
    scene : what to show
    size_px : (width, height)
    supersampling : samples per pixel and axis

    Raises
    ------
    ValueError
        A size below 1 px.

    Notes
    -----
    A pixel's colour is the mean of its samples in linear light.  Its depth is that of
    one sample, the second nearest of each four, so that it is never a depth at which
    nothing is: a mean across an edge would be.
    """

    def __init__(self, scene: Scene, size_px: tuple[int, int], *, supersampling=2):
        width, height = size_px
        if min(width, height, supersampling) < 1:
            raise ValueError(f"size {width}x{height} px, {supersampling} samples: >= 1")
        self.scene, self.size_px = scene, size_px
        self._samples = supersampling
        up = float(np.tan(np.deg2rad(scene.fov_deg) / 2))
        right = up * width / height
        self.tangents = (-right, right, up, -up)
        self._world = pyrender.Scene(bg_color=[*scene.background_srgb, 1.0])
        self._world.add(pyrender.Mesh([_primitive(batch) for batch in scene.batches]))
        camera = pyrender.PerspectiveCamera(
            yfov=np.deg2rad(scene.fov_deg),
            aspectRatio=width / height,
            znear=scene.near_m,
            zfar=scene.far_m,
        )
        self._camera = self._world.add(camera)
        self._renderer = pyrender.OffscreenRenderer(
            width * supersampling, height * supersampling
        )
        release_context(self._renderer)

    def __enter__(self) -> "SceneRenderer":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Free the GL context."""
        delete_renderer(self._renderer)

    def render(self, pose: Array) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour (h, w, 3) and planar depth (h, w) seen from a pose (4, 4)."""
        self._world.set_pose(self._camera, pose)
        color, depth_m = self._renderer.render(self._world, _FLAGS)
        release_context(self._renderer)
        nothing = (depth_m == 0) | (depth_m >= self.scene.infinite_from_m)
        depth_m = np.where(nothing, np.float32(np.inf), depth_m)
        if self._samples == 1:
            return np.ascontiguousarray(color), depth_m
        return _mean_color(color, self._samples), _sample_depth(depth_m, self._samples)


def scene_frames(
    scene: Scene,
    path: tuple[Key, ...] | None,
    n_frames: int,
    size_px: tuple[int, int],
) -> Iterator[SceneFrame]:
    """Render a scene along a camera path, the scene's own when `path` is None."""
    moments = path_moments(path or PATHS[scene.name], n_frames)
    with SceneRenderer(scene, size_px) as renderer:
        for moment in moments:
            color, depth_m = renderer.render(moment.pose)
            yield SceneFrame(
                color=color,
                depth_m=depth_m,
                tangents=renderer.tangents,
                pose=moment.pose,
                pupil_diameter_mm=moment.pupil_diameter_mm,
                focus_dpt=moment.focus_dpt,
            )


def _primitive(batch) -> "pyrender.Primitive":
    """Hand one batch to pyrender as an unlit, two-sided draw call."""
    alpha = np.ones((len(batch.srgb), 1), np.float32)
    return pyrender.Primitive(
        positions=batch.vertices_m,
        indices=batch.faces,
        texcoord_0=batch.uv if batch.texture is not None else None,
        color_0=np.concatenate([batch.srgb, alpha], axis=1),
        material=pyrender.MetallicRoughnessMaterial(
            baseColorTexture=batch.texture, doubleSided=True
        ),
    )


_LINEAR_FROM_SRGB8 = np.array(
    [
        v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4
        for v in np.arange(256) / 255.0
    ],
    np.float32,
)
_STEPS = 4096
_SRGB8_FROM_LINEAR = np.round(
    255
    * np.array(
        [
            12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055
            for v in np.arange(_STEPS + 1) / _STEPS
        ]
    )
).astype(np.uint8)


def _mean_color(color, samples: int) -> NDArray[np.uint8]:
    """Average blocks of sRGB samples in linear light; tables keep it fast."""
    linear = _LINEAR_FROM_SRGB8[color]
    # Strided sums are several times faster than mean() over a five-axis view.
    total = sum(
        linear[row::samples, column::samples]
        for row in range(samples)
        for column in range(samples)
    )
    steps = total * np.float32(_STEPS / samples**2) + np.float32(0.5)
    return _SRGB8_FROM_LINEAR[steps.astype(np.int32)]


def _sample_depth(depth_m, samples: int) -> NDArray[np.float32]:
    """Pick from each block the sample a quarter of the way from the nearest."""
    h, w = depth_m.shape[0] // samples, depth_m.shape[1] // samples
    blocks = depth_m.reshape(h, samples, w, samples).swapaxes(1, 2).reshape(h, w, -1)
    rank = samples * samples // 4
    return np.partition(blocks, rank, axis=-1)[..., rank].astype(np.float32)
