"""Off-screen rendering of a scene's color and depth along a camera path.

A path gives position, target, focus and pupil of an eye over time.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clients.scenes.geometry import Array, Scene
from clients.scenes.scene_view import Picture, SceneView, Tangents, open_context
from filter_service import RgbdView
from filter_service.messages import State, WithState


@dataclass(frozen=True)
class SceneFrame(WithState):
    """An RGB-D frame and the state of the eye that looks at it.

    Attributes
    ----------
    color : (h, w, 3) uint8
        sRGB, top row first.
    depth_m : (h, w) float32
        Planar depth; +inf is the background.
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges.
    pose : (4, 4) array
        Camera to world.
    state : State
        State of the eye at this point of the path; without a gaze, straight ahead.
    hidden_color, hidden_depth_m : arrays, optional
        Color and depth of the hidden layer; depth is 0 where nothing is hidden.
    right_view : RgbdView, optional
        What the right eye sees in a stereo frame, whose other images are the left
        eye's.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    tangents: tuple[float, float, float, float]
    pose: Array
    state: State
    hidden_color: NDArray[np.uint8] | None = None
    hidden_depth_m: NDArray[np.float32] | None = None
    right_view: RgbdView | None = None

    @property
    def view(self) -> RgbdView:
        """Return the images in the client library's type; in stereo, the left ones."""
        return RgbdView(
            self.color,
            self.depth_m,
            self.tangents,
            hidden_color=self.hidden_color,
            hidden_depth_m=self.hidden_depth_m,
        )

    @property
    def views(self) -> list[RgbdView]:
        """Return one view, or the views of the left and the right eye."""
        return [self.view] if self.right_view is None else [self.view, self.right_view]


def eye_poses(pose: Array, ipd_mm: float | None) -> list[Array]:
    """Return the poses (4, 4) of the left and the right eye, or of one eye.

    Parameters
    ----------
    pose : (4, 4) array
        Camera to world, of the point between the eyes.
    ipd_mm : float, optional
        Interpupillary distance; None is one eye, at that point.

    Raises
    ------
    ValueError
        If the distance is not a positive number.
    """
    if ipd_mm is None:
        return [pose]
    if not 0.0 < ipd_mm < np.inf:
        raise ValueError(f"ipd_mm is {ipd_mm:g}; allowed: above 0")
    poses = [np.array(pose, float), np.array(pose, float)]
    for side, eye in zip((-1.0, 1.0), poses, strict=True):
        eye[:3, 3] += side * ipd_mm / 2000.0 * eye[:3, 0]
    return poses


class SceneRenderer:
    """Off-screen renderer of one scene, in its own OpenGL context.

    Between calls no OpenGL context is current, so that a window's context can be.

    Parameters
    ----------
    scene : Scene
        Scene to render.
    size_px : (int, int)
        Width and height of an image.
    supersampling : int
        Samples per pixel along each axis; see `SceneView`.
    is_linear : bool
        Whether colors are linear light in float32, which may exceed 1.

    Raises
    ------
    ValueError
        If a size is below 1 px or larger than OpenGL can render here.
    RenderFailed
        If this machine offers no OpenGL context.
    """

    def __init__(
        self,
        scene: Scene,
        size_px: tuple[int, int],
        *,
        supersampling: int = 3,
        is_linear: bool = False,
    ):
        self._context = open_context()
        try:
            self._view = SceneView(
                self._context,
                scene,
                size_px,
                supersampling=supersampling,
                is_linear=is_linear,
            )
        except BaseException:
            self._context.release()
            raise
        self.scene, self.size_px = scene, size_px
        up = float(np.tan(np.deg2rad(scene.fov_deg) / 2))
        right = up * size_px[0] / size_px[1]
        self.tangents = (-right, right, up, -up)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._view.close()
        self._context.release()

    def render(self, pose: Array) -> Picture:
        """Return color (h, w, 3) and planar depth (h, w) seen from a pose (4, 4)."""
        return self._view.render(pose, self.tangents)

    def render_layers(self, pose: Array) -> tuple[Picture, Picture]:
        """Return color and depth of the visible surface and of the hidden layer.

        See `SceneView.render_layers`.
        """
        return self._view.render_layers(pose, self.tangents)


def scene_frames(
    scene: Scene,
    path: tuple[Key, ...] | None,
    n_frames: int,
    size_px: tuple[int, int],
    *,
    with_hidden: bool = False,
    repeats: bool = False,
    ipd_mm: float | None = None,
) -> Generator[SceneFrame, None, None]:
    """Render a scene along a camera path.

    Parameters
    ----------
    scene : Scene
        Scene to render.
    path : tuple of Key, optional
        Camera path; None is the scene's own.
    n_frames : int
        Number of frames along the path.
    size_px : (int, int)
        Width and height of a frame.
    with_hidden : bool
        Whether to render the hidden layer.
    repeats : bool
        Whether to follow the path back and forth, endlessly.
    ipd_mm : float, optional
        Interpupillary distance of stereo frames; None renders one view.
    """
    moments = path_moments(path or PATHS[scene.name], n_frames)
    with SceneRenderer(scene, size_px) as renderer:

        def render(pose: Array) -> tuple[NDArray[Any], ...]:
            if not with_hidden:
                return renderer.render(pose)
            visible, hidden = renderer.render_layers(pose)
            return *visible, *hidden

        for moment in back_and_forth(moments) if repeats else moments:
            yield frame_at(moment, render, renderer.tangents, ipd_mm)


def frame_at(
    moment: Moment,
    render: Callable[[Array], tuple[Any, ...]],
    tangents: Tangents,
    ipd_mm: float | None,
) -> SceneFrame:
    """Render the frame of one eye, or the stereo frame of the left and right eye.

    Parameters
    ----------
    moment : Moment
        Pose of the point between the eyes, pupil and focus.
    render : callable
        Returns color and depth seen from a pose (4, 4), followed by color and
        depth of the hidden layer, if there is one.
    tangents, ipd_mm
        As for `SceneFrame` and `scene_frames`.
    """
    eyes = []
    for pose in eye_poses(moment.pose, ipd_mm):
        color, depth_m, *hidden = render(pose)
        eyes.append(SceneFrame(color, depth_m, tangents, pose, moment.state, *hidden))
    return replace(eyes[0], right_view=eyes[1].view) if len(eyes) > 1 else eyes[0]


def back_and_forth(moments: list[Moment]) -> Iterator[Moment]:
    """Follow a path to its end, back to its beginning, and so on."""
    return cycle(moments + moments[-2:0:-1])


# Camera paths


@dataclass(frozen=True)
class Key:
    """Key frame of a path.

    Attributes
    ----------
    position_m, target_m : (float, float, float)
        Positions of the eye and of the point in the image center.
    pupil_diameter_mm : float
        Pupil of the eye.
    focus_m : float
        Focus distance, meters; may be inf.
    """

    position_m: tuple[float, float, float]
    target_m: tuple[float, float, float]
    pupil_diameter_mm: float
    focus_m: float


@dataclass(frozen=True)
class Moment(WithState):
    """State of the eye, and pose of the camera (4, 4, camera to world), in a frame."""

    pose: Array
    state: State


PATHS = {
    "courtyard": (
        Key((0.02, 1.16, 0.02), (-0.10, 0.98, -4.0), 3.0, 4.0),
        Key((0.06, 1.17, -0.03), (0.08, 0.93, -4.0), 4.0, 2.5),
        Key((0.02, 1.19, -0.05), (-0.06, 0.99, -5.0), 4.95, 14.0),
        Key((-0.04, 1.18, -0.03), (-0.20, 0.86, -3.0), 4.5, 0.7),
        Key((-0.02, 1.15, 0.03), (-0.30, 0.98, -4.0), 3.0, 0.5),
    ),
    "primitives": (
        Key((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 4.95, 4.17),
        Key((0.03, 0.02, -0.01), (0.02, 0.0, -1.0), 4.5, 1.0),
        Key((0.0, 0.03, 0.01), (-0.05, 0.0, -1.0), 4.0, 0.39),
        Key((-0.03, 0.01, 0.0), (-0.02, 0.02, -1.0), 3.0, 0.25),
        Key((-0.01, 0.0, 0.0), (0.0, 0.0, -1.0), 4.0, 4.17),
    ),
    "night_road": (
        Key((0.0, 1.2, 0.0), (-0.8, 1.0, -30.0), 5.6, 40.0),
        Key((0.02, 1.2, -0.04), (-0.4, 1.0, -30.0), 5.0, 20.0),
        Key((0.0, 1.21, -0.08), (0.2, 0.9, -30.0), 4.5, 0.8),
    ),
    "stairs": (
        Key((0.0, 0.0, 0.0), (0.0, -0.84, -1.0), 3.1, 2.5),
        Key((0.03, -0.01, -0.05), (0.05, -0.74, -1.05), 3.6, 4.0),
        Key((0.0, 0.0, -0.02), (0.0, -0.94, -1.0), 4.2, 0.6),
    ),
}


def path_moments(path: tuple[Key, ...], n_frames: int) -> list[Moment]:
    """Interpolate a path from its first key to its last.

    Parameters
    ----------
    path : tuple of Key
        At least two keys, spread evenly over the frames.
    n_frames : int
        Number of frames, at least 1.

    Raises
    ------
    ValueError
        If there are too few keys or frames.

    Notes
    -----
    The path is a Catmull-Rom spline through the keys.  Focus is interpolated in
    diopters, which measure the effort of the eye.
    """
    if len(path) < 2 or n_frames < 1:
        raise ValueError(
            f"path has {len(path)} keys and n_frames is {n_frames}; allowed: 2 keys or "
            "more, 1 frame or more"
        )
    values = np.array(
        [
            (*key.position_m, *key.target_m, key.pupil_diameter_mm, 1 / key.focus_m)
            for key in path
        ]
    )
    moments = []
    for t in np.linspace(0, len(path) - 1, n_frames):
        row = _catmull_rom(values, t)
        focus_dpt = float(max(row[7], 0.0))
        pose = look_at(row[:3], row[3:6])
        moments.append(Moment(pose, State(float(row[6]), focus_dpt)))
    return moments


def _catmull_rom(values: Array, t: float) -> Array:
    """Return the spline through the rows of `values` at t, from 0 to rows - 1."""
    i = min(int(t), len(values) - 2)
    s = t - i
    before = values[max(i - 1, 0)]
    first, second = values[i], values[i + 1]
    after = values[min(i + 2, len(values) - 1)]
    slope_a, slope_b = (second - before) / 2, (after - first) / 2
    return (
        (2 * s**3 - 3 * s**2 + 1) * first
        + (s**3 - 2 * s**2 + s) * slope_a
        + (3 * s**2 - 2 * s**3) * second
        + (s**3 - s**2) * slope_b
    )


def look_at(position_m: ArrayLike, target_m: ArrayLike) -> Array:
    """Return the pose (4, 4), camera to world, of an upright camera."""
    position_m = np.asarray(position_m, float)
    back = position_m - np.asarray(target_m, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(back, right), back
    pose[:3, 3] = position_m
    return pose
