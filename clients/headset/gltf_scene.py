"""glTF files as scenes, with simple, fixed light baked into the vertices."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.headset.gltf_file import Part, read_parts
from clients.scenes.geometry import Array, Mesh, transformed
from clients.scenes.scene import Batch, Scene, finished
from estimator import InvalidFile

MAX_EXTENT_M = 10_000.0
"""A larger scene is a landscape, or is not in meters, the unit of glTF."""

PIECE_TRIANGLES = 250_000
"""Triangles of a part that are converted at a time; each takes 0.4 kB of memory."""

NEAR_M = 0.05
LEAST_FAR_M = 10.0
BACKGROUND_SRGB = (0.75, 0.75, 0.75)

_SKY = np.array([0.42, 0.45, 0.50])
_GROUND = np.array([0.22, 0.20, 0.18])
_SUN = np.array([0.55, 0.53, 0.48])
_TO_SUN = np.array([0.40, 0.80, 0.45]) / np.linalg.norm([0.40, 0.80, 0.45])
"""Linear light on a white surface; the total is at most 1."""


def load_gltf(path: str | Path) -> Scene:
    """Return the scene of a .glb or .gltf file, in meters, y up.

    Raises
    ------
    InvalidFile
        If the file is invalid (see `read_parts`), has positions that are not finite, or
        is larger than `MAX_EXTENT_M`.
    """
    path = Path(path)
    batches, corners_m = [], []
    with np.errstate(over="ignore", invalid="ignore"):  # positions that are not finite
        for part in read_parts(
            path
        ):  # one at a time: a batch takes a sixth of a part's memory
            for mesh in _meshes(part):
                low_m, high_m = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
                corners_m += [low_m, high_m]
                textures = {} if part.texture is None else {mesh.texture: part.texture}
                batches.append(finished(mesh, light_on(mesh.normals), textures))
        extent_m = float(np.linalg.norm(np.ptp(corners_m, axis=0)))
    if not extent_m <= MAX_EXTENT_M:
        allowed = f"at most {MAX_EXTENT_M:g} m"
        raise InvalidFile(path, f"{extent_m:.3g} m across", allowed)
    # The viewer may stand outside (see `viewpoint`) and walk.
    far_m = max(LEAST_FAR_M, 4.0 * extent_m)
    return Scene(
        name=path.name,
        batches=tuple(_by_texture(batches)),
        background_srgb=BACKGROUND_SRGB,
        near_m=NEAR_M,
        far_m=far_m,
        infinite_from_m=far_m,
    )


def light_on(normals: Array) -> Array:
    """Return the light (n, 3) on surfaces with normals (n, 3).

    Notes
    -----
    A surface tilted by t receives (1 + cos t) / 2 of the light of a uniform sky and
    (1 - cos t) / 2 of the light of a uniform ground (Liu and Jordan 1963, Solar Energy
    7, 53-74), and the light of the sun by its cosine. There are no shadows.
    """
    cosine = normals[:, 1:2]
    around = _SKY * (1.0 + cosine) / 2.0 + _GROUND * (1.0 - cosine) / 2.0
    return around + _SUN * np.maximum(normals @ _TO_SUN, 0.0)[:, None]


def _by_texture(batches: list[Batch]) -> list[Batch]:
    """Merge the batches of each texture, so that a frame takes few draw calls."""
    groups: dict[int, list[Batch]] = {}
    while batches:  # each is freed once its group is merged
        batch = batches.pop(0)
        groups.setdefault(id(batch.texture), []).append(batch)
    return [_merged(group) for group in groups.values()]


def _merged(batches: list[Batch]) -> Batch:
    counts = [len(batch.vertices_m) for batch in batches]
    starts = np.cumsum([0, *counts[:-1]], dtype=np.int64).astype(np.uint32)
    return Batch(
        vertices_m=np.concatenate([b.vertices_m for b in batches]),
        faces=np.concatenate(
            [b.faces + start for b, start in zip(batches, starts, strict=True)]
        ),
        uv=np.concatenate([b.uv for b in batches]),
        srgb=np.concatenate([b.srgb for b in batches]),
        texture=batches[0].texture,
    )


def _meshes(part: Part) -> Iterator[Mesh]:
    """Yield a part as meshes in the world frame, with normals as glTF specifies."""
    for start in range(0, len(part.faces), PIECE_TRIANGLES):
        faces = part.faces[start : start + PIECE_TRIANGLES]
        is_whole = len(faces) == len(part.faces)
        used = np.arange(len(part.vertices_m))
        if part.normals is None:  # flat faces share no vertices
            used, faces = faces.ravel(), np.arange(faces.size).reshape(-1, 3)
        elif not is_whole:
            is_used = np.zeros(len(used), bool)
            is_used[faces] = True
            used, faces = np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces]
        yield _mesh(part, used, faces)


def _mesh(part: Part, used: NDArray[np.int64], faces: NDArray[np.int64]) -> Mesh:
    """Return a mesh of some triangles and the vertices that they use."""
    vertices_m = part.vertices_m[used].astype(float)
    albedo = part.reflectance_ratio[used]
    uv = np.zeros((len(used), 2)) if part.uv is None else part.uv[used].astype(float)
    if part.normals is None:
        a, b, c = (vertices_m[k::3] for k in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.repeat(normals / np.maximum(length, 1e-12), 3, axis=0)
    else:
        normals = part.normals[used].astype(float)
    dark = np.zeros_like(albedo)
    mesh = Mesh(
        vertices_m=vertices_m,
        normals=normals,
        faces=faces,
        albedo=dark if part.is_unlit else albedo,
        emission=albedo if part.is_unlit else dark,
        translucency=np.zeros(len(normals)),
        uv=uv,
        texture="" if part.texture is None else str(id(part.texture)),
    )
    return transformed(mesh, part.world_from_part)
