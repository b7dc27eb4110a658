"""Scenes for pyrender: files that trimesh loads, and the built-in scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from clients.pyrender_renderer import pyrender
from clients.scenes.geometry import Array
from clients.scenes.paths import Moment, look_at
from clients.scenes.scene import Batch, Scene
from estimator import InvalidFile

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
    alpha = np.ones((len(batch.srgb), 1), np.float32)
    return pyrender.Primitive(
        positions=batch.vertices_m,
        indices=batch.faces,
        texcoord_0=None if batch.texture is None else batch.uv,
        color_0=np.concatenate([batch.srgb, alpha], axis=1),
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
    if path.stat().st_size > MAX_FILE_BYTES:
        found = f"{path.stat().st_size:,} bytes"
        raise InvalidFile(path, found, f"at most {MAX_FILE_BYTES:,}")
    try:
        # Textures and materials of OBJ and glTF may be in other files beside it.
        content = trimesh.load_scene(path)
    except Exception as error:  # the readers raise what they meet
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InvalidFile(
            path, f"cannot be read ({reason:.200})", "a file that trimesh loads"
        ) from error
    found = pyrender.Scene(bg_color=[*BACKGROUND_SRGB, 1.0], ambient_light=_AMBIENT)
    corners_m: list[Array] = []
    meshes: dict[str, pyrender.Mesh] = {}
    scale = np.diag([m_per_unit] * 3 + [1.0])
    n_parts = len(content.graph.nodes_geometry)
    if n_parts > MAX_PARTS:
        raise InvalidFile(path, f"{n_parts:,} parts", f"at most {MAX_PARTS:,}")
    for node in content.graph.nodes_geometry:
        world_from_node, name = content.graph[node]
        shape = content.geometry[name]
        if not isinstance(shape, trimesh.Trimesh) or not len(shape.faces):
            continue  # points and curves
        pose = scale @ world_from_node
        corners_m.append(trimesh.transform_points(_corners(shape.bounds), pose))
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


def _corners(bounds: Array) -> Array:
    """Return the eight corners of a box (2, 3)."""
    picked = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    return np.take_along_axis(bounds, picked, axis=0)


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
        focus_dpt = ratio / near_m + (1.0 - ratio) / far_m
        pupil_mm = _PUPILS_MM[0] + (_PUPILS_MM[1] - _PUPILS_MM[0]) * ratio
        moments.append(
            Moment(look_at(position_m, center_m), float(pupil_mm), float(focus_dpt))
        )
    return camera, moments
