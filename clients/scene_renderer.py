"""Off-screen rendering of a scene's color and depth with pyrender."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.hidden_surface import LEAST_GAP_DPT, HiddenSurface
from clients.pyrender_setup import delete_renderer, pyrender, release_context
from clients.scenes.geometry import Array
from clients.scenes.paths import PATHS, Key, Moment, path_moments
from clients.scenes.scene import Batch, Scene

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
    gaze_deg : (h, v), gaze direction in the image; None is straight ahead
    hidden_color, hidden_depth_m : color and depth of the hidden layer, if requested;
        depth 0 where nothing is hidden
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    pose: Array
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None = None
    hidden_color: NDArray[np.uint8] | None = None
    hidden_depth_m: NDArray[np.float32] | None = None


class SceneRenderer:
    """An off-screen renderer of one scene.

    Parameters
    ----------
    scene : scene to render
    size_px : (width, height)
    supersampling : samples per pixel and axis

    Raises
    ------
    ValueError
        If a size is below 1 px.

    Notes
    -----
    A pixel's color is the mean of its samples in linear light.  Its depth is that of
    one sample, the second nearest of each four, so that a surface exists at that depth,
    unlike at the mean across an edge.
    """

    def __init__(
        self, scene: Scene, size_px: tuple[int, int], *, supersampling: int = 2
    ):
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
        self._hidden = HiddenSurface(self._renderer, (scene.near_m, scene.far_m))
        release_context(self._renderer)

    def __enter__(self) -> "SceneRenderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the GL context."""
        self._hidden.close()
        delete_renderer(self._renderer)

    def render(self, pose: Array) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return color (h, w, 3) and planar depth (h, w) seen from a pose (4, 4)."""
        return self._render(pose, with_hidden=False)[0]

    def render_layers(
        self, pose: Array
    ) -> tuple[tuple[NDArray[Any], NDArray[Any]], ...]:
        """Return color and depth of the visible surface and of the hidden layer.

        Depth of the hidden layer is 0 where nothing is hidden.  Its color is the mean
        of the pixel's samples that have a hidden surface.
        """
        return self._render(pose, with_hidden=True)

    def _render(
        self, pose: Array, *, with_hidden: bool
    ) -> tuple[tuple[NDArray[Any], NDArray[Any]], ...]:
        self._world.set_pose(self._camera, pose)
        color, raw_m = self._renderer.render(self._world, _FLAGS)
        layers = [(color, self._with_infinity(raw_m))]
        if with_hidden:
            color, hidden_m = self._hidden.render(self._world, _FLAGS, raw_m)
            layers.append((color, self._with_infinity(hidden_m)))
        release_context(self._renderer)
        seen = self._pixels(*layers[0])
        if not with_hidden:
            return (seen,)
        shows = _is_behind(layers[0][1], layers[1][1])
        return seen, _hidden_pixels(*layers[1], shows, seen[1], self._samples)

    def _with_infinity(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        nothing = (depth_m == 0) | (depth_m >= self.scene.infinite_from_m)
        return np.where(nothing, np.float32(np.inf), depth_m)

    def _pixels(
        self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        if self._samples == 1:
            return np.ascontiguousarray(color), depth_m
        return _mean_color(color, self._samples), _sample_depth(depth_m, self._samples)


def scene_frames(
    scene: Scene,
    path: tuple[Key, ...] | None,
    n_frames: int,
    size_px: tuple[int, int],
    *,
    with_hidden: bool = False,
) -> Generator[SceneFrame, None, None]:
    """Render a scene along a camera path; `path` None is the scene's own."""
    moments = path_moments(path or PATHS[scene.name], n_frames)
    with SceneRenderer(scene, size_px) as renderer:
        for moment in moments:
            yield frame_at(renderer, moment, with_hidden=with_hidden)


def frame_at(
    renderer: SceneRenderer, moment: Moment, *, with_hidden: bool = False
) -> SceneFrame:
    """Render one moment of a path."""
    hidden: tuple[NDArray[Any] | None, NDArray[Any] | None] = (None, None)
    if with_hidden:
        seen, hidden = renderer.render_layers(moment.pose)
    else:
        seen = renderer.render(moment.pose)
    return SceneFrame(
        color=seen[0],
        depth_m=seen[1],
        tangents=renderer.tangents,
        pose=moment.pose,
        pupil_diameter_mm=moment.pupil_diameter_mm,
        focus_dpt=moment.focus_dpt,
        hidden_color=hidden[0],
        hidden_depth_m=hidden[1],
    )


def _primitive(batch: Batch) -> "pyrender.Primitive":
    """Convert one batch to an unlit, two-sided draw call of pyrender."""
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


def _is_behind(
    seen_m: NDArray[np.float32], hidden_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return where the hidden surface is far enough behind to matter."""
    return 1.0 / seen_m - 1.0 / hidden_m >= LEAST_GAP_DPT


def _hidden_pixels(
    color: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    shows: NDArray[np.bool_],
    seen_m: NDArray[np.float32],
    samples: int,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return color and depth of hidden pixels from the samples that have a surface.

    Depth is 0 unless it lies behind the pixel's visible depth: a surface behind a
    sliver of a nearer one is visible in the pixel already.
    """
    light = _blocks(_LINEAR_FROM_SRGB8[color] * shows[..., None], samples).sum(axis=2)
    count = _blocks(shows, samples).sum(axis=2)
    light /= np.maximum(count, 1)[..., None]
    # Missing samples sort last; the rank counts only the others.
    ordered = np.sort(
        _blocks(np.where(shows, depth_m, np.float32(np.nan)), samples), axis=2
    )
    rank = np.minimum(count // 4, np.maximum(count - 1, 0))
    picked = np.take_along_axis(ordered, rank[..., None], axis=2)[..., 0]
    holds = np.zeros(count.shape, bool)
    holds[count > 0] = _is_behind(seen_m[count > 0], picked[count > 0])
    depth = np.where(holds, picked, np.float32(0.0)).astype(np.float32)
    steps = (light * np.float32(_STEPS) + np.float32(0.5)).astype(np.int32)
    return _SRGB8_FROM_LINEAR[steps], depth


def _blocks(image: NDArray[Any], samples: int) -> NDArray[Any]:
    """Return the samples (h, w, n, ...) of each pixel."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    split = image.reshape(height, samples, width, samples, *image.shape[2:])
    return split.swapaxes(1, 2).reshape(height, width, -1, *image.shape[2:])


def _mean_color(color: NDArray[np.uint8], samples: int) -> NDArray[np.uint8]:
    """Average blocks of sRGB samples in linear light, with tables for speed."""
    linear = _LINEAR_FROM_SRGB8[color]
    # Strided sums are several times faster than mean() over a five-axis view.
    total = sum(
        linear[row::samples, column::samples]
        for row in range(samples)
        for column in range(samples)
    )
    steps = total * np.float32(_STEPS / samples**2) + np.float32(0.5)
    return _SRGB8_FROM_LINEAR[steps.astype(np.int32)]


def _sample_depth(depth_m: NDArray[np.float32], samples: int) -> NDArray[np.float32]:
    """Pick from each block the sample a quarter of the way from the nearest."""
    h, w = depth_m.shape[0] // samples, depth_m.shape[1] // samples
    blocks = depth_m.reshape(h, samples, w, samples).swapaxes(1, 2).reshape(h, w, -1)
    rank = samples * samples // 4
    return np.partition(blocks, rank, axis=-1)[..., rank].astype(np.float32)
