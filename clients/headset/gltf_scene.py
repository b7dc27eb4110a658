"""Any glTF file as a scene: its light is simple, fixed, and baked into its vertices."""

from pathlib import Path

import numpy as np

from clients.headset.gltf_file import Part, read_parts
from clients.scenes.geometry import (
    Array,
    Mesh,
    by_texture,
    transformed,
    vertex_normals,
)
from clients.scenes.scene import Scene, finished

MAX_EXTENT_M = 10_000.0
"""What is larger is in other units than metres, as glTF has them, or a landscape."""

NEAR_M = 0.05
LEAST_FAR_M = 10.0
BACKGROUND_SRGB = (0.75, 0.75, 0.75)

_SKY = np.array([0.42, 0.45, 0.50])
_GROUND = np.array([0.22, 0.20, 0.18])
_SUN = np.array([0.55, 0.53, 0.48])
_TO_SUN = np.array([0.40, 0.80, 0.45]) / np.linalg.norm([0.40, 0.80, 0.45])
"""Light on white, linear; none of it is above 1 on any surface."""


def load_gltf(path: str | Path) -> Scene:
    """Return the scene of a .glb or .gltf file, in metres, y up.

    Raises
    ------
    ValueError
        What is wrong with the file, which it names: see `read_parts`; or a place that
        is no number, or more than `MAX_EXTENT_M` across.
    """
    path = Path(path)
    parts = read_parts(path)
    textures = {str(id(p.texture)): p.texture for p in parts if p.texture is not None}
    meshes = by_texture([_mesh(part) for part in parts])
    extent_m = _extent_m(meshes)
    if not extent_m <= MAX_EXTENT_M:
        raise ValueError(f"{path}: {extent_m:.3g} m across; at most {MAX_EXTENT_M:g}")
    # Twice that: the viewer may stand outside, see `viewpoint`, and walk.
    far_m = max(LEAST_FAR_M, 4.0 * extent_m)
    return Scene(
        name=path.name,
        batches=tuple(finished(m, light_on(m.normals), textures) for m in meshes),
        background_srgb=BACKGROUND_SRGB,
        near_m=NEAR_M,
        far_m=far_m,
        infinite_from_m=far_m,
    )


def light_on(normals: Array) -> Array:
    """Return the light (n, 3) on surfaces with these normals (n, 3).

    Notes
    -----
    A uniform sky and a uniform ground fill (1 + cos t) / 2 and (1 - cos t) / 2 of what
    a surface tilted by t sees (Liu and Jordan 1963, Solar Energy 7, 53-74).  The sun
    adds its cosine.  Nothing casts a shadow.
    """
    cosine = normals[:, 1:2]
    around = _SKY * (1.0 + cosine) / 2.0 + _GROUND * (1.0 - cosine) / 2.0
    return around + _SUN * np.maximum(normals @ _TO_SUN, 0.0)[:, None]


def _extent_m(meshes: list[Mesh]) -> float:
    """Return the diagonal of the box around all; NaN where a place is none."""
    low_m = np.min([mesh.vertices_m.min(axis=0) for mesh in meshes], axis=0)
    high_m = np.max([mesh.vertices_m.max(axis=0) for mesh in meshes], axis=0)
    return float(np.linalg.norm(high_m - low_m))


def _mesh(part: Part) -> Mesh:
    """Return a part in the world's frame, its normals as glTF wants them."""
    columns = {"vertices_m": part.vertices_m, "albedo": part.reflectance_ratio}
    columns["uv"] = np.zeros((len(part.vertices_m), 2)) if part.uv is None else part.uv
    faces, normals = part.faces, part.normals
    if normals is None:  # each face is flat, and has its corners for itself
        columns = {name: values[faces.ravel()] for name, values in columns.items()}
        faces = np.arange(faces.size).reshape(-1, 3)
        normals = vertex_normals(columns["vertices_m"], faces)
    dark = np.zeros_like(columns["albedo"])
    light = {"emission": dark}
    if part.is_unlit:
        light = {"emission": columns["albedo"], "albedo": dark}
    mesh = Mesh(
        normals=normals,
        faces=faces,
        translucency=np.zeros(len(normals)),
        texture="" if part.texture is None else str(id(part.texture)),
        **(columns | light),
    )
    return transformed(mesh, part.world_from_part)
