"""glTF files as scenes, with simple, fixed light baked into the vertices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.headset.gltf_file import Container, accessor_array, accessor_count
from clients.headset.runtime import rotation_of
from clients.scenes.geometry import Array, Batch, Mesh, Scene, finished, transformed
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


# Triangles and appearance of each part.  The contents of a file are counted before any
# are copied: a file may place one mesh a thousand times, or contain an image of a
# gigabyte.

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


@dataclass(frozen=True)
class Part:
    """A primitive of a mesh, placed by a node of the file.

    Attributes
    ----------
    world_from_part : (4, 4) array
        Transformation to the world frame.
    vertices_m : (n, 3) array
        Positions as stored.
    faces : (m, 3) array
        Vertex indices of the triangles.
    normals : (n, 3) array or None
        Normals as stored, if the file has any.
    uv : (n, 2) array or None
        Texture coordinates, v up.
    reflectance_ratio : (n, 3) array
        Linear color factor, without the texture.
    texture : (h, w, 3) uint8 or None
        sRGB; parts may share a texture.
    is_unlit : bool
        Whether the color is independent of the light.
    """

    world_from_part: Array
    vertices_m: NDArray[np.float32]
    faces: NDArray[np.int64]
    normals: NDArray[np.float32] | None
    uv: NDArray[np.float32] | None
    reflectance_ratio: Array
    texture: NDArray[np.uint8] | None
    is_unlit: bool


def read_parts(path: Path) -> Iterator[Part]:
    """Yield the triangles of a .glb or .gltf file, part by part.

    Raises
    ------
    InvalidFile
        If the file does not exist, is not glTF 2, requires unknown extensions, is
        damaged, has no triangles, or is too large.

    Notes
    -----
    Transparency is not supported: parts that are blended with an opacity below
    `LEAST_WEIGHT_RATIO` are left out, and all others are opaque. Skins, morph targets
    and animations are ignored.
    """
    file = Container(path)
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
    materials = [_material(file, primitive) for _, primitive in placed]
    textures.check(materials)
    n_parts = 0
    for (matrix, primitive), material in zip(placed, materials, strict=True):
        if not _is_shown(file, material):
            continue
        n_parts += 1
        yield _part(file, matrix, primitive, material, textures)
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
    counts = {id(p): _triangle_count(file, p) for p in primitives}
    n_triangles = sum(counts[id(p)] for p in primitives)
    if n_triangles > MAX_TRIANGLES:
        file.refuse(f"{n_triangles:,} triangles", f"at most {MAX_TRIANGLES:,}")
    counts = {
        id(p): accessor_count(file, p["attributes"].get("POSITION"))
        if "NORMAL" in p["attributes"]
        else 3 * counts[id(p)]
        for p in primitives
    }
    n_vertices = sum(counts[id(p)] for p in primitives)
    if n_vertices > MAX_VERTICES:
        file.refuse(f"{n_vertices:,} vertices", f"at most {MAX_VERTICES:,}")


def _material(file: Container, primitive: dict[str, Any]) -> dict[str, Any]:
    index = primitive.get("material")
    return {} if index is None else file.entry("materials", index)


def _object(file: Container, entry: dict[str, Any], field: str) -> dict[str, Any]:
    found = entry.get(field, {})
    if not isinstance(found, dict):
        file.refuse(f"damaged: '{field}' is not an object")
    return found


def _factor(file: Container, material: dict[str, Any]) -> Array:
    surface = _object(file, material, "pbrMetallicRoughness")
    given = surface.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
    is_four = isinstance(given, list) and len(given) == 4
    if not is_four or not all(type(v) in (int, float) for v in given):
        file.refuse("damaged: a baseColorFactor", "four numbers")
    return np.array(given, float)


def _is_shown(file: Container, material: dict[str, Any]) -> bool:
    weight = _factor(file, material)[3]
    return material.get("alphaMode") != "BLEND" or weight >= LEAST_WEIGHT_RATIO


def _part(
    file: Container,
    matrix: Array,
    primitive: dict[str, Any],
    material: dict[str, Any],
    textures: _Textures,
) -> Part:
    attributes = primitive["attributes"]
    vertices_m = _columns(file, attributes, "POSITION", 3, kinds="f")
    n = len(vertices_m)
    normals = uv = None
    if "NORMAL" in attributes:
        normals = _columns(file, attributes, "NORMAL", 3, kinds="f", count=n)
        if not np.ptp(normals) > 0.0:
            normals = None
    if "TEXCOORD_0" in attributes:
        uv = _columns(file, attributes, "TEXCOORD_0", 2, kinds="fu", count=n)
        uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    return Part(
        world_from_part=matrix,
        vertices_m=vertices_m,
        faces=_faces(file, primitive, n),
        normals=normals,
        uv=uv,
        reflectance_ratio=_reflectance(file, material, attributes, n),
        texture=None if uv is None else textures.of(material),
        is_unlit="KHR_materials_unlit" in _object(file, material, "extensions"),
    )


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
    if "COLOR_0" not in attributes:
        return np.broadcast_to(factor, (n, 3))
    colors = accessor_array(file, attributes["COLOR_0"], kinds="fu")
    if len(colors) != n or colors.shape[1] < 3:
        return np.broadcast_to(factor, (n, 3))
    top = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0
    return factor * (np.asarray(colors, float)[:, :3] / top)


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

_SIZES = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


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
    origin = np.eye(4)
    waiting = [(k, origin, 1) for k in reversed(_numbers(file, scene, "nodes"))]
    while waiting:
        k, world_from_parent, depth = waiting.pop()
        if not 0 <= k < len(nodes):
            file.refuse(f"damaged: node {k}", f"0 to {len(nodes) - 1}")
        if k in seen:
            file.refuse(f"damaged: node {k} occurs twice in the tree", "once")
        if depth > MAX_NODE_DEPTH:
            found_text = f"nodes more than {MAX_NODE_DEPTH} deep"
            file.refuse(found_text, f"at most {MAX_NODE_DEPTH}")
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
    for name, size in _SIZES.items():
        given = node.get(name)
        if given is None:
            continue
        is_list = isinstance(given, list) and len(given) == size
        if not is_list or not all(type(v) in (int, float) for v in given):
            file.refuse(f"damaged: nodes[{k}].{name}", f"{size} numbers")
        values[name] = np.array(given, float)
    matrix = np.eye(4)
    if "matrix" in values:
        matrix = values["matrix"].reshape(4, 4).T
    if "translation" in values:
        moved = np.eye(4)
        moved[:3, 3] = values["translation"]
        matrix = matrix @ moved
    if "rotation" in values:
        length = np.linalg.norm(values["rotation"])
        if length > np.finfo(float).tiny:
            matrix[:3, :3] = matrix[:3, :3] @ rotation_of(values["rotation"] / length)
    if "scale" in values:
        matrix = matrix @ np.diag([*values["scale"], 1.0])
    return matrix
