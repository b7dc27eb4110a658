"""Off-screen rendering of pyrender scenes: color and planar depth in meters.

    from clients.pyrender_renderer import pyrender, pyrender_frames

Import pyrender from here, or set PYOPENGL_PLATFORM before you import it: PyOpenGL
reads the variable once.  This module sets it to ``egl`` unless it is set; ``osmesa``
requires PyOpenGL 3.1.5 or later, which pyrender's own requirements exclude.

A process that imports pyopenxr cannot import this module, because pyopenxr makes
PyOpenGL use GLX.
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Generator, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from clients.scene_renderer import Moment, SceneFrame, frame_at, look_at
from clients.scenes.geometry import (
    Array,
    Batch,
    Scene,
    linear_from_srgb,
    srgb_from_linear,
)
from clients.scenes.scene_view import (
    Picture,
    Tangents,
    check_pose,
    check_size,
    open_context,
)
from estimator import InvalidFile
from filter_service.errors import RenderFailed
from filter_service.messages import State

_PLATFORMS = {"egl": "EGLPlatform", "osmesa": "OSMesaPlatform"}
_PLATFORM = os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
if _PLATFORM not in _PLATFORMS:
    raise RenderFailed(
        f"PYOPENGL_PLATFORM is {_PLATFORM!r}; allowed: {', '.join(_PLATFORMS)}"
    )

with warnings.catch_warnings():
    # Old syntax in third-party files.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("ignore", SyntaxWarning)
    if "pyglet" not in sys.modules:
        import pyglet

        # pyrender imports its viewer, for which pyglet otherwise requires X11.
        pyglet.options["headless"] = True
    try:
        import OpenGL.platform
        import pyrender
        from OpenGL import GL
        from OpenGL.arrays.ctypesparameters import CtypesParameterHandler
    except ModuleNotFoundError:
        raise
    except (ImportError, AttributeError) as error:
        raise RenderFailed(
            f"PyOpenGL cannot use the platform {_PLATFORM}; egl requires libEGL, and "
            f"osmesa libOSMesa and PyOpenGL 3.1.5 or later: {error}"
        ) from error

# PyOpenGL 3.1.0 does not find its handler of references with Python 3.12 or later, and
# then creates no textures.
CtypesParameterHandler().register([type(ctypes.byref(ctypes.c_int()))])

if type(OpenGL.platform.PLATFORM).__name__ != _PLATFORMS[_PLATFORM]:
    raise RenderFailed(
        "PyOpenGL was imported before PYOPENGL_PLATFORM was set; import "
        "clients.pyrender_renderer first, and not together with pyopenxr"
    )

__all__ = ["PyrenderRenderer", "camera_tangents", "pyrender", "pyrender_frames"]

USUAL_PUPIL_MM = 4.0

_FLAGS = pyrender.RenderFlags
_LINEAR_FROM_SRGB8 = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
_STEPS = 4096
_SRGB8_FROM_LINEAR = np.round(
    255.0 * srgb_from_linear(np.arange(_STEPS + 1) / _STEPS)
).astype(np.uint8)


class _OSMesaContext:
    """A context of Mesa's renderer in memory; it is current within the block."""

    def __init__(self) -> None:
        try:
            from pyrender.platforms.osmesa import OSMesaPlatform

            # The images are in framebuffer objects, and not in this one.
            self._platform = OSMesaPlatform(1, 1)
            self._platform.init_context()
        except (ImportError, AttributeError, TypeError, OpenGL.error.Error) as error:
            raise RenderFailed(
                "no OSMesa context, which requires libOSMesa and PyOpenGL 3.1.5 or "
                f"later: {error}"
            ) from error

    def __enter__(self) -> None:
        self._platform.make_current()

    def __exit__(self, *_: object) -> None:
        from OpenGL.osmesa import OSMesaMakeCurrent

        OSMesaMakeCurrent(None, None, GL.GL_UNSIGNED_BYTE, 0, 0)

    def release(self) -> None:
        """Delete the context."""
        self._platform.delete_context()


class _SampledCamera(pyrender.Camera):
    """A camera for images of a size in pixels, whatever the number of samples."""

    def __init__(self, camera: pyrender.Camera, size_px: tuple[int, int]) -> None:
        self._camera, self._size_px = camera, size_px
        super().__init__(znear=camera.znear, zfar=camera.zfar)

    @property
    def zfar(self) -> float | None:
        return self._camera.zfar

    @zfar.setter
    def zfar(self, value: float | None) -> None:
        """Keep the camera's zfar; pyrender's setter does not accept None."""

    def get_projection_matrix(
        self, width: int | None = None, height: int | None = None
    ) -> Array:
        # An intrinsics camera is in pixels of the image, not in samples.
        return np.asarray(self._camera.get_projection_matrix(*self._size_px), float)


class _SingleSampleRenderer(pyrender.Renderer):
    """pyrender's renderer with one sample per pixel, at its center."""

    _is_multisampled = True

    def _configure_main_framebuffer(self) -> None:
        super()._configure_main_framebuffer()
        if self._is_multisampled:
            size = (self.viewport_width, self.viewport_height)
            for buffer, form in (
                (self._main_cb_ms, GL.GL_RGBA),
                (self._main_db_ms, GL.GL_DEPTH_COMPONENT24),
            ):
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
                GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, form, *size)
            self._is_multisampled = False


class PyrenderRenderer:
    """Off-screen renderer of a pyrender scene, in its own OpenGL context.

    Between calls no OpenGL context is current, so that a window's context can be.  The
    scene may change between calls.  Its meshes belong to one renderer at a time.

    Parameters
    ----------
    scene : pyrender.Scene
        Scene to render, in meters.
    size_px : (int, int)
        Width and height of an image.
    flags : int
        Flags of `pyrender.RenderFlags`, such as ``FLAT``.
    supersampling : int
        Samples per pixel along each axis.
    infinite_from_m : float
        Planar depth from which a surface counts as background, at infinity.

    Raises
    ------
    ValueError
        If a size is below 1 px or larger than OpenGL can render here.
    RenderFailed
        If this machine offers no OpenGL context.

    Notes
    -----
    A pixel's color is the mean of its samples in linear light, and its depth the
    depth of one sample, as for `SceneView`.  Samples are taken at their centers:
    pyrender's own four-fold multisampling averages sRGB values, and takes the depth of
    a point that OpenGL does not specify, which is wrong by 0.4 px of slope.
    """

    def __init__(
        self,
        scene: pyrender.Scene,
        size_px: tuple[int, int],
        *,
        flags: int = 0,
        supersampling: int = 3,
        infinite_from_m: float = np.inf,
    ) -> None:
        self.scene, self.size_px = scene, size_px
        self._flags = (flags | _FLAGS.OFFSCREEN) & ~_FLAGS.DEPTH_ONLY
        self._samples, self._infinite_from_m = supersampling, infinite_from_m
        # Not `pyrender.OffscreenRenderer`, which terminates its EGL display when it is
        # deleted, and with it all contexts of this process.
        self._context: Any = open_context() if _PLATFORM == "egl" else _OSMesaContext()
        try:
            with self._context:
                largest = min(
                    int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE)),
                    *map(int, GL.glGetIntegerv(GL.GL_MAX_VIEWPORT_DIMS)),
                )
                check_size(size_px, supersampling, largest)
                width_px, height_px = size_px
                self._renderer: Any = _SingleSampleRenderer(
                    supersampling * width_px, supersampling * height_px
                )
        except BaseException:
            self._context.release()
            raise

    def __enter__(self) -> PyrenderRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL objects and the context; closing twice is allowed."""
        if self._renderer is not None:
            with self._context:
                self._renderer.delete()
            self._renderer = None
            self._context.release()

    def render(self, camera: pyrender.Camera, pose: Array) -> Picture:
        """Render the scene as a camera sees it.

        Parameters
        ----------
        camera : pyrender.Camera
            Perspective or intrinsics camera; its ``zfar`` may be None.
        pose : (4, 4) array
            Camera to world; x right, y up, looking along -z.

        Returns
        -------
        color : (h, w, 3) uint8
            sRGB, top row first.
        depth_m : (h, w) float32
            Planar depth; +inf for the background.

        Raises
        ------
        ValueError
            If the pose or the camera does not describe a perspective view.
        RenderFailed
            If OpenGL reports an error.
        """
        camera_tangents(camera, self.size_px)
        scene = self.scene
        previous = scene.main_camera_node
        sampled = _SampledCamera(camera, self.size_px)
        node = scene.add(sampled, pose=check_pose(pose))
        scene.main_camera_node = node
        try:
            with self._context:
                if self._flags & _FLAGS.SHADOWS_DIRECTIONAL:
                    _fill_bounds(scene)
                color, depth_m = self._renderer.render(scene, self._flags)
        except OpenGL.error.Error as error:
            reason = " ".join(str(error).split())
            raise RenderFailed(f"pyrender: {reason:.200}") from error
        finally:
            scene.remove_node(node)
            if previous is not None:
                scene.main_camera_node = previous
        missing = (depth_m == 0.0) | (depth_m >= self._infinite_from_m)
        depth_m = np.where(missing, np.float32(np.inf), depth_m)
        if self._samples == 1:
            return np.ascontiguousarray(color[..., :3]), depth_m
        return _mean_color(color, self._samples), _one_depth(depth_m, self._samples)


def pyrender_frames(
    scene: pyrender.Scene,
    size_px: tuple[int, int],
    *,
    camera: pyrender.Camera | None = None,
    path: Iterable[Moment] | None = None,
    ipd_mm: float | None = None,
    flags: int = 0,
    supersampling: int = 3,
    infinite_from_m: float = np.inf,
) -> Generator[SceneFrame, None, None]:
    """Render a pyrender scene along a camera path.

    Parameters
    ----------
    scene : pyrender.Scene
        Scene to render, in meters.  It may change between frames.
    size_px : (int, int)
        Width and height of a frame.
    camera : pyrender.Camera, optional
        Camera; None is the main camera of the scene.
    path : iterable of Moment, optional
        Pose of the camera, pupil and focus of each frame, possibly endless (see
        `clients.scene_renderer`).  None is one frame from the pose of the scene's main
        camera, with a pupil of 4 mm and the focus at infinity.
    ipd_mm : float, optional
        Interpupillary distance of stereo frames.  Their poses refer to the midpoint
        between the eyes.  None renders one view.
    flags, supersampling, infinite_from_m
        As for `PyrenderRenderer`.

    Yields
    ------
    SceneFrame

    Raises
    ------
    ValueError
        If the scene has no camera and none is given, or as for `PyrenderRenderer`.
    RenderFailed
        As for `PyrenderRenderer`.
    """
    main = scene.main_camera_node
    if main is None and (camera is None or path is None):
        raise ValueError("the scene has no camera; allowed: one, or a camera and path")
    if camera is None:
        camera = main.camera
    if path is None:
        path = [Moment(scene.get_pose(main), State(USUAL_PUPIL_MM, 0.0))]
    tangents = camera_tangents(camera, size_px)
    with PyrenderRenderer(
        scene,
        size_px,
        flags=flags,
        supersampling=supersampling,
        infinite_from_m=infinite_from_m,
    ) as renderer:
        for moment in path:
            yield frame_at(moment, partial(renderer.render, camera), tangents, ipd_mm)


def camera_tangents(camera: pyrender.Camera, size_px: tuple[int, int]) -> Tangents:
    """Return the tangents (left, right, up, down) of a pyrender camera.

    Raises
    ------
    ValueError
        If the camera has no perspective, or its near plane is at 0.
    """
    matrix = np.asarray(camera.get_projection_matrix(*size_px), float)
    if not np.array_equal(matrix[3], (0.0, 0.0, -1.0, 0.0)) or matrix[0, 1]:
        name = type(camera).__name__
        raise ValueError(f"camera is a {name}; allowed: one with a perspective")
    if not camera.znear > 0.0:
        raise ValueError(f"znear of the camera is {camera.znear:g}; allowed: above 0")
    x, y = matrix[0, 0], matrix[1, 1]
    left, right = (matrix[0, 2] - 1.0) / x, (matrix[0, 2] + 1.0) / x
    down, up = (matrix[1, 2] - 1.0) / y, (matrix[1, 2] + 1.0) / y
    return float(left), float(right), float(up), float(down)


def _fill_bounds(scene: pyrender.Scene) -> None:
    """Compute the bounds of meshes, for shadows.

    pyrender 0.1.45 computes them with `numpy.infty`, which NumPy 2 does not have.
    """
    for mesh in scene.meshes:
        if mesh._bounds is None and mesh.primitives:
            corners = np.concatenate([part.bounds for part in mesh.primitives])
            mesh._bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])


def _mean_color(color: NDArray[np.uint8], samples: int) -> NDArray[np.uint8]:
    """Return the mean of each pixel's samples in linear light, by tables."""
    height, width = color.shape[0] // samples, color.shape[1] // samples
    total = np.zeros((height, width, 3), np.float32)
    for row in range(samples):  # faster than a mean over two of five axes
        for column in range(samples):
            total += _LINEAR_FROM_SRGB8[color[row::samples, column::samples, :3]]
    steps = total * np.float32(_STEPS / samples**2) + np.float32(0.5)
    return _SRGB8_FROM_LINEAR[steps.astype(np.int32)]


def _one_depth(depth_m: NDArray[np.float32], samples: int) -> NDArray[np.float32]:
    """Return the depth of the sample a quarter of the way from the nearest."""
    height, width = depth_m.shape[0] // samples, depth_m.shape[1] // samples
    blocks = depth_m.reshape(height, samples, width, samples).swapaxes(1, 2)
    rank = samples**2 // 4
    ordered = np.partition(blocks.reshape(height, width, -1), rank, axis=-1)
    return np.ascontiguousarray(ordered[..., rank])


# Files that trimesh loads, and the built-in scenes

MAX_FILE_BYTES = 500_000_000
MAX_PARTS = 15_000
"""Meshes placed by nodes, each of which takes 0.2 ms of every frame."""

MAX_EXTENT_M = 10_000.0
LEAST_DISTANCE_M = 0.25
"""Nearer surfaces are out of focus for most people."""

FIELD_OF_VIEW_DEG = 50.0
BACKGROUND_SRGB = (0.75, 0.75, 0.75)

BUILT_IN_FLAGS = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
"""Flags for scenes with baked light and open surfaces."""

_AMBIENT = (0.35, 0.35, 0.35)
_LAMPS = ((3.0, (0.5, 0.8, 0.6)), (1.5, (-0.8, 0.3, -0.4)))
"""Intensity of each lamp, and where it shines from."""

_WITH_NORMALS = (".glb", ".gltf")
"""Files that are smooth where their normals say so; others get flat faces, because
normals computed from their vertices would round their edges."""

_MARGIN = 1.1
_HEIGHT_RATIO = 0.3
_PUPILS_MM = (3.0, 5.0)


class LoadedFile(NamedTuple):
    """Scene of a file, and its corners (2, 3) in meters."""

    scene: pyrender.Scene
    bounds_m: Array


def built_in(scene: Scene) -> tuple[pyrender.Scene, pyrender.PerspectiveCamera]:
    """Return a built-in scene for pyrender, and its camera; see `BUILT_IN_FLAGS`."""
    found = pyrender.Scene(bg_color=[*scene.background_srgb, 1.0])
    found.add(pyrender.Mesh([_primitive(batch) for batch in scene.batches]))
    camera = pyrender.PerspectiveCamera(
        yfov=np.deg2rad(scene.fov_deg), znear=scene.near_m, zfar=scene.far_m
    )
    return found, camera


def _primitive(batch: Batch) -> pyrender.Primitive:
    color = np.concatenate([batch.srgb, np.ones((len(batch.srgb), 1), np.float32)], 1)
    return pyrender.Primitive(
        positions=batch.vertices_m,
        indices=batch.faces,
        texcoord_0=None if batch.texture is None else batch.uv,
        color_0=color,
        material=pyrender.MetallicRoughnessMaterial(
            baseColorTexture=batch.texture, doubleSided=True
        ),
    )


def load_file(path: str | Path, *, m_per_unit: float = 1.0) -> LoadedFile:
    """Return the scene of a file that trimesh loads, with light and without a camera.

    Parameters
    ----------
    path : str or Path
        For example a .glb, .gltf, .obj, .stl or .ply file.
    m_per_unit : float
        Meters per unit of the file; 1 for glTF.

    Raises
    ------
    InvalidFile
        If the file does not exist, cannot be read, has no triangles, or exceeds
        `MAX_FILE_BYTES`, `MAX_PARTS` or `MAX_EXTENT_M`.
    ValueError
        If ``m_per_unit`` is not a positive number.
    """
    path = Path(path)
    if not 0.0 < m_per_unit < np.inf:
        raise ValueError(f"m_per_unit is {m_per_unit:g}; allowed: above 0")
    if not path.is_file():
        raise InvalidFile(path, "does not exist", "a file that trimesh loads")
    n_bytes = path.stat().st_size
    if n_bytes > MAX_FILE_BYTES:
        raise InvalidFile(path, f"{n_bytes:,} bytes", f"at most {MAX_FILE_BYTES:,}")
    try:
        # Textures and materials of OBJ and glTF may be in other files beside it.
        content = trimesh.load_scene(path)
    except Exception as error:  # the readers raise exceptions of any type
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InvalidFile(
            path, f"cannot be read ({reason:.200})", "a file that trimesh loads"
        ) from error
    found = pyrender.Scene(bg_color=[*BACKGROUND_SRGB, 1.0], ambient_light=_AMBIENT)
    corners_m: list[Array] = []
    meshes: dict[str, pyrender.Mesh] = {}
    n_parts = len(content.graph.nodes_geometry)
    if n_parts > MAX_PARTS:
        raise InvalidFile(path, f"{n_parts:,} parts", f"at most {MAX_PARTS:,}")
    for node in content.graph.nodes_geometry:
        world_from_node, name = content.graph[node]
        shape = content.geometry[name]
        if not isinstance(shape, trimesh.Trimesh) or not len(shape.faces):
            continue  # points and curves
        pose = np.diag([m_per_unit] * 3 + [1.0]) @ world_from_node
        corners = trimesh.bounds.corners(shape.bounds)
        corners_m.append(trimesh.transform_points(corners, pose))
        if name not in meshes:
            meshes[name] = _mesh(shape, is_smooth=path.suffix.lower() in _WITH_NORMALS)
        found.add(meshes[name], pose=pose)
    if not corners_m:
        raise InvalidFile(path, "no triangles to show", "a file with a mesh")
    points_m = np.concatenate(corners_m)
    bounds_m = np.stack([points_m.min(axis=0), points_m.max(axis=0)])
    extent_m = float(np.linalg.norm(bounds_m[1] - bounds_m[0]))
    if not 0.0 < extent_m <= MAX_EXTENT_M:
        allowed = f"above 0 and at most {MAX_EXTENT_M:g} m; see --m-per-unit"
        raise InvalidFile(path, f"{extent_m:.3g} m across", allowed)
    for intensity, from_m in _LAMPS:
        lamp = pyrender.DirectionalLight(color=np.ones(3), intensity=intensity)
        found.add(lamp, pose=look_at(from_m, (0.0, 0.0, 0.0)))
    return LoadedFile(found, bounds_m)


def _mesh(shape: trimesh.Trimesh, *, is_smooth: bool) -> pyrender.Mesh:
    material: Any = getattr(shape.visual, "material", None)
    # trimesh has None where a file says nothing; pyrender wants numbers.  Without
    # surroundings to reflect, the default of glTF, a metal, would be black.
    if getattr(material, "metallicFactor", 0.0) is None:
        material.metallicFactor = 0.0
    if getattr(material, "roughnessFactor", 0.0) is None:
        material.roughnessFactor = 1.0
    has_faces = shape.visual.kind == "face"
    return pyrender.Mesh.from_trimesh(shape, smooth=is_smooth and not has_faces)


def orbit(
    bounds_m: Array, n_frames: int, size_px: tuple[int, int]
) -> tuple[pyrender.PerspectiveCamera, list[Moment]]:
    """Return a camera and its path once around a box that it sees as a whole.

    Meanwhile the focus moves from the near side of the box to its far side and back,
    and the pupil opens and closes.

    Parameters
    ----------
    bounds_m : (2, 3) array
        Corners of the box.
    n_frames : int
        Number of frames, at least 1.
    size_px : (int, int)
        Width and height of a frame.

    Raises
    ------
    ValueError
        If there are too few frames.
    """
    if n_frames < 1:
        raise ValueError(f"n_frames is {n_frames}; allowed: 1 or more")
    center_m = np.asarray(bounds_m, float).mean(axis=0)
    radius_m = float(np.linalg.norm(bounds_m[1] - bounds_m[0])) / 2.0
    up = np.tan(np.deg2rad(FIELD_OF_VIEW_DEG) / 2.0)
    half_angle = np.arctan(up * min(1.0, size_px[0] / size_px[1]))
    distance_m = _MARGIN * radius_m / np.sin(half_angle)
    distance_m = max(distance_m, radius_m + LEAST_DISTANCE_M)
    near_m, far_m = distance_m - radius_m, distance_m + radius_m
    camera = pyrender.PerspectiveCamera(
        yfov=np.deg2rad(FIELD_OF_VIEW_DEG), znear=0.5 * near_m
    )
    moments = []
    for turn in 2.0 * np.pi * np.arange(n_frames) / n_frames:
        toward = np.array([np.sin(turn), _HEIGHT_RATIO, np.cos(turn)])
        position_m = center_m + distance_m * toward / np.linalg.norm(toward)
        ratio = (1.0 + np.cos(turn)) / 2.0
        focus_dpt = float(ratio / near_m + (1.0 - ratio) / far_m)
        pupil_mm = float(_PUPILS_MM[0] + (_PUPILS_MM[1] - _PUPILS_MM[0]) * ratio)
        state = State(pupil_mm, focus_dpt)
        moments.append(Moment(look_at(position_m, center_m), state))
    return camera, moments
