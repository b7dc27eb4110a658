"""glTF files as scenes, with simple, fixed light baked into the vertices."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.headset.gltf_file import Container, accessor_array, accessor_count
from clients.headset.runtime import rotation_of
from clients.scenes.geometry import (
    Array,
    Batch,
    Mesh,
    Scene,
    finished,
    transformed,
    unit,
)
from estimator import InvalidFile
from filter_service.pictures import check_picture, read_texture

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

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 6_000_000
"""Placed vertices, three for each triangle without normals. Each takes 32 bytes; two
million triangles take 3 to 5 s."""

MAX_DRAWS = 15_000
"""Parts placed by nodes; each takes 0.25 ms."""

MAX_TEXTURE_PIXELS = 1 << 26
"""Total pixels of all textures; each takes three bytes."""

LEAST_VOLUME_RATIO = 1e-30
"""A node that scales volumes by less is treated as not invertible."""

LEAST_WEIGHT_RATIO = 0.5
"""Parts that are blended with less opacity are left out."""

_TRIANGLES, _STRIP = 4, 5
_KNOWN_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")
"""Prefixes of required extensions that this reader ignores."""

_PICTURES = ("", "image/png", "image/jpeg", "image/webp")


def load_gltf(path: str | Path) -> Scene:
    """Return the scene of a .glb or .gltf file, in meters, y up.

    Raises
    ------
    InvalidFile
        If the file does not exist, is not glTF 2, requires unknown extensions, is
        damaged, has no triangles, has positions that are not finite, or is too large.

    Notes
    -----
    Transparency is not supported: parts that are blended with an opacity below
    `LEAST_WEIGHT_RATIO` are left out, and all others are opaque. Skins, morph targets
    and animations are ignored.
    """
    path = Path(path)
    batches, corners_m = [], []
    with np.errstate(over="ignore", invalid="ignore"):  # positions that are not finite
        # One mesh at a time: a batch takes a sixth of its memory.
        for mesh, texture in _meshes(Container(path)):
            corners_m += [mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)]
            textures = {} if texture is None else {mesh.texture: texture}
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


# Triangles and appearance of each part.  The contents of a file are counted before any
# are copied: a file may place one mesh a thousand times, or contain an image of a
# gigabyte.


def _meshes(file: Container) -> Iterator[tuple[Mesh, NDArray[np.uint8] | None]]:
    """Yield the triangles of a file with their textures, piece by piece."""
    required = file.header.get("extensionsRequired", [])
    for name in required if isinstance(required, list) else [required]:
        if not isinstance(name, str) or not name.startswith(_KNOWN_EXTENSIONS):
            file.refuse(f"requires the extension {name!s:.60}, which is not supported")
    placed = []
    for matrix, mesh in placed_meshes(file):
        if abs(np.linalg.det(matrix[:3, :3])) > LEAST_VOLUME_RATIO:
            placed += [(matrix, primitive) for primitive in _primitives(file, mesh)]
        if len(placed) > MAX_DRAWS:  # a million would take half a minute to count
            file.refuse(f"more than {MAX_DRAWS:,} parts", f"at most {MAX_DRAWS:,}")
    _check_counts(file, [primitive for _, primitive in placed])
    textures = _Textures(file)
    materials = [
        {}
        if primitive.get("material") is None
        else file.entry("materials", primitive["material"])
        for _, primitive in placed
    ]
    textures.check(materials)
    n_parts = 0
    for (matrix, primitive), material in zip(placed, materials, strict=True):
        factor = _factor(file, material)
        if material.get("alphaMode") == "BLEND" and factor[3] < LEAST_WEIGHT_RATIO:
            continue
        n_parts += 1
        yield from _pieces(file, matrix, primitive, material, textures)
    if not n_parts:
        file.refuse("no triangles to show")


def _primitives(file: Container, mesh: int) -> list[dict[str, Any]]:
    """Return the triangles among a mesh's primitives, without lines and points."""
    primitives = file.entry("meshes", mesh).get("primitives")
    if not isinstance(primitives, list):
        file.refuse(f"damaged: meshes[{mesh}].primitives is not a list")
    for primitive in primitives:
        attributes = primitive.get("attributes") if isinstance(primitive, dict) else 0
        if not isinstance(attributes, dict):
            file.refuse(f"damaged: a primitive of meshes[{mesh}] has no attributes")
    return [
        primitive
        for primitive in primitives
        if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP)
        and _triangle_count(file, primitive) > 0
    ]


def _triangle_count(file: Container, primitive: dict[str, Any]) -> int:
    corners = primitive.get("indices", primitive["attributes"].get("POSITION"))
    count = accessor_count(file, corners)
    return count - 2 if primitive.get("mode", _TRIANGLES) == _STRIP else count // 3


def _check_counts(file: Container, primitives: list[dict[str, Any]]) -> None:
    """Reject counts above the limits; a primitive counts once per placement."""
    n_triangles = sum(_triangle_count(file, p) for p in primitives)
    if n_triangles > MAX_TRIANGLES:
        file.refuse(f"{n_triangles:,} triangles", f"at most {MAX_TRIANGLES:,}")
    n_vertices = sum(
        accessor_count(file, p["attributes"].get("POSITION"))
        if "NORMAL" in p["attributes"]
        else 3 * _triangle_count(file, p)
        for p in primitives
    )
    if n_vertices > MAX_VERTICES:
        file.refuse(f"{n_vertices:,} vertices", f"at most {MAX_VERTICES:,}")


def _object(file: Container, entry: dict[str, Any], field: str) -> dict[str, Any]:
    found = entry.get(field, {})
    if not isinstance(found, dict):
        file.refuse(f"damaged: '{field}' is not an object")
    return found


def _factor(file: Container, material: dict[str, Any]) -> Array:
    surface = _object(file, material, "pbrMetallicRoughness")
    given = surface.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
    if not file.are_numbers(given, 4):
        file.refuse("damaged: a baseColorFactor", "four numbers")
    return np.array(given, float)


def _pieces(
    file: Container,
    world_from_part: Array,
    primitive: dict[str, Any],
    material: dict[str, Any],
    textures: _Textures,
) -> Iterator[tuple[Mesh, NDArray[np.uint8] | None]]:
    """Yield a part in the world frame, with normals as glTF specifies."""
    attributes = primitive["attributes"]
    vertices_m = _columns(file, attributes, "POSITION", 3, kinds="f")
    n = len(vertices_m)
    normals = uv = texture = None
    if "NORMAL" in attributes:
        normals = _columns(file, attributes, "NORMAL", 3, kinds="f", count=n)
        if not np.ptp(normals) > 0.0:
            normals = None
    if "TEXCOORD_0" in attributes:
        uv = _columns(file, attributes, "TEXCOORD_0", 2, kinds="fu", count=n)
        uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    corners = _faces(file, primitive, n)
    reflectance_ratio = _reflectance(file, material, attributes, n)
    if uv is not None:
        texture = textures.of(material)
    is_unlit = "KHR_materials_unlit" in _object(file, material, "extensions")
    for start in range(0, len(corners), PIECE_TRIANGLES):
        faces = corners[start : start + PIECE_TRIANGLES]
        used = np.arange(n)
        if normals is None:  # flat faces share no vertices
            used, faces = faces.ravel(), np.arange(faces.size).reshape(-1, 3)
        elif len(faces) < len(corners):
            is_used = np.zeros(n, bool)
            is_used[faces] = True
            used, faces = np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces]
        points_m = vertices_m[used].astype(float)
        color = reflectance_ratio[used]
        dark = np.zeros_like(color)
        mesh = Mesh(
            vertices_m=points_m,
            normals=_flat(points_m) if normals is None else normals[used].astype(float),
            faces=faces,
            albedo=dark if is_unlit else color,
            emission=color if is_unlit else dark,
            translucency=np.zeros(len(used)),
            uv=np.zeros((len(used), 2)) if uv is None else uv[used].astype(float),
            texture="" if texture is None else str(id(texture)),
        )
        yield transformed(mesh, world_from_part), texture


def _flat(vertices_m: Array) -> Array:
    """Return the normals of triangles that share no vertices."""
    a, b, c = (vertices_m[k::3] for k in range(3))
    return np.repeat(unit(np.cross(b - a, c - a)), 3, axis=0)


def _columns(
    file: Container,
    attributes: dict[str, Any],
    name: str,
    columns: int,
    *,
    kinds: str,
    count: int | None = None,
) -> NDArray[Any]:
    """Return a vertex attribute; integers become fractions of their largest value."""
    array = accessor_array(file, attributes.get(name), kinds=kinds)
    if array.shape[1] < columns or count not in (None, len(array)):
        found = f"damaged: {name} has {len(array):,} entries of {array.shape[1]}"
        file.refuse(found, f"{count or len(array):,} of {columns}")
    if array.dtype.kind == "u":
        return array / np.float32(np.iinfo(array.dtype).max)
    return array


def _reflectance(
    file: Container, material: dict[str, Any], attributes: dict[str, Any], n: int
) -> Array:
    """Return the linear color factor (n, 3) of each vertex."""
    factor = _factor(file, material)[:3]
    if "COLOR_0" in attributes:
        colors = accessor_array(file, attributes["COLOR_0"], kinds="fu")
        if len(colors) == n and colors.shape[1] >= 3:
            top = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0
            return factor * (np.asarray(colors, float)[:, :3] / top)
    return np.broadcast_to(factor, (n, 3))


def _faces(
    file: Container, primitive: dict[str, Any], n_vertices: int
) -> NDArray[np.int64]:
    corners = np.arange(n_vertices)
    if "indices" in primitive:
        stored = accessor_array(file, primitive["indices"], kinds="u")
        corners = stored[:, 0].astype(np.int64)
        if len(corners) and int(corners.max()) >= n_vertices:
            found = f"damaged: a triangle with vertex {int(corners.max()):,}"
            file.refuse(found, f"0 to {n_vertices - 1:,}")
    if primitive.get("mode", _TRIANGLES) == _STRIP:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]  # consistent winding
        return faces
    if len(corners) % 3:
        file.refuse(
            f"damaged: {len(corners):,} triangle corners", "a multiple of three"
        )
    return corners.reshape(-1, 3)


class _Textures:
    """Images of a file: headers are checked at once, images are decoded when used."""

    def __init__(self, file: Container) -> None:
        self._file = file
        self._decoded: dict[int, NDArray[np.uint8]] = {}

    def check(self, materials: list[dict[str, Any]]) -> None:
        """Reject images with too many pixels, from their headers alone."""
        distinct = {id(m): m for m in materials}.values()
        images = sorted({i for m in distinct if (i := self._image_of(m)) is not None})
        n_pixels = 0
        for index in images:
            n_pixels += check_picture(self._content(index), name=self._name(index))
            if n_pixels > MAX_TEXTURE_PIXELS:
                found = f"textures of {n_pixels:,} pixels or more"
                self._file.refuse(found, f"at most {MAX_TEXTURE_PIXELS:,}")

    def of(self, material: dict[str, Any]) -> NDArray[np.uint8] | None:
        """Return the texture of a material, or None."""
        index = self._image_of(material)
        if index is None:
            return None
        if index not in self._decoded:
            content, name = self._content(index), self._name(index)
            self._decoded[index] = read_texture(content, name=name)
        return self._decoded[index]

    def _image_of(self, material: dict[str, Any]) -> int | None:
        """Return the index of a material's image; None without a supported one."""
        surface = _object(self._file, material, "pbrMetallicRoughness")
        if "baseColorTexture" not in surface:
            return None
        reference = _object(self._file, surface, "baseColorTexture")
        texture = self._file.entry("textures", reference.get("index"))
        extensions = _object(self._file, texture, "extensions")
        webp = _object(self._file, extensions, "EXT_texture_webp")
        index = webp.get("source", texture.get("source"))
        if index is None:
            return None
        kind = self._file.entry("images", index).get("mimeType", "")
        return index if kind in _PICTURES else None

    def _content(self, index: int) -> bytes:
        image = self._file.entry("images", index)
        if "bufferView" in image:
            return bytes(self._file.view(image["bufferView"]))
        return self._file.uri_bytes(image.get("uri"))

    def _name(self, index: int) -> str:
        return f"{self._file.path}, image {index}"


# Tree of nodes

MAX_NODE_DEPTH = 1000
"""Nesting depth of nodes: a skeleton has about 20, and a chain of links about 100."""

_TRANSFORMATIONS = {
    "matrix": np.eye(4).ravel(),
    "translation": np.zeros(3),
    "rotation": np.array([0.0, 0.0, 0.0, 1.0]),
    "scale": np.ones(3),
}
"""Default of each part of a node's transformation."""


def placed_meshes(file: Container) -> Iterator[tuple[Array, int]]:
    """Yield (world_from_mesh, mesh index) for each placed mesh of the default scene.

    The matrices are (4, 4). The traversal is not recursive.

    Raises
    ------
    InvalidFile
        If the nodes do not form a tree, are nested too deep, or have transformations
        that are not finite.
    """
    if not file.list_of("scenes"):
        return
    scene = file.entry("scenes", file.header.get("scene", 0))
    nodes = file.list_of("nodes")
    seen: set[int] = set()
    waiting = [(k, np.eye(4), 1) for k in reversed(_numbers(file, scene, "nodes"))]
    while waiting:
        k, world_from_parent, depth = waiting.pop()
        if not 0 <= k < len(nodes):
            file.refuse(f"damaged: node {k}", f"0 to {len(nodes) - 1}")
        if k in seen:
            file.refuse(f"damaged: node {k} occurs twice in the tree", "once")
        if depth > MAX_NODE_DEPTH:
            file.refuse(
                f"nodes more than {MAX_NODE_DEPTH} deep", f"at most {MAX_NODE_DEPTH}"
            )
        seen.add(k)
        node = nodes[k]
        with np.errstate(all="ignore"):
            world_from_node = world_from_parent @ _local(file, node, k)
        if not np.isfinite(world_from_node).all():
            file.refuse(
                f"damaged: the transformation of node {k} is not finite", "finite"
            )
        if "mesh" in node:
            file.entry("meshes", node["mesh"])
            yield world_from_node, node["mesh"]
        children = _numbers(file, node, "children")
        waiting += [(c, world_from_node, depth + 1) for c in reversed(children)]


def _numbers(file: Container, entry: dict[str, Any], field: str) -> list[int]:
    found = entry.get(field, [])
    if not isinstance(found, list) or not all(type(k) is int for k in found):
        file.refuse(f"damaged: '{field}' is not a list of integers")
    return found


def _local(file: Container, node: dict[str, Any], k: int) -> Array:
    """Return the matrix (4, 4) from a node's frame to its parent's."""
    values: dict[str, Array] = {}
    for name, usual in _TRANSFORMATIONS.items():
        given = node.get(name)
        if given is not None and not file.are_numbers(given, usual.size):
            file.refuse(f"damaged: nodes[{k}].{name}", f"{usual.size} numbers")
        values[name] = usual if given is None else np.array(given, float)
    moved = np.eye(4)
    moved[:3, 3] = values["translation"]
    matrix = values["matrix"].reshape(4, 4).T @ moved
    length = np.linalg.norm(values["rotation"])
    if length > np.finfo(float).tiny:
        matrix[:3, :3] = matrix[:3, :3] @ rotation_of(values["rotation"] / length)
    return matrix @ np.diag([*values["scale"], 1.0])
