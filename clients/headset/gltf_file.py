"""Read a glTF file into triangles with the look that each part of it has."""

import io
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from clients.scenes.geometry import Array

MAX_FILE_MB = 1000.0
MAX_TRIANGLES = 5_000_000
LEAST_VOLUME_RATIO = 1e-30
"""A node that shrinks volumes to less has no inverse."""

LEAST_WEIGHT_RATIO = 0.5
"""What is blended with less is left out."""

_MAGIC = b"glTF"
_JSON_CHUNK = b"JSON"
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_KNOWN_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")
"""How the names of those begin without which a file is shown all the same."""


@dataclass(frozen=True)
class Part:
    """One primitive of a mesh, as one node of the file places it.

    Attributes
    ----------
    world_from_part : (4, 4)
    vertices_m : (n, 3)
    faces : (m, 3)
    normals : (n, 3), or None where the file has none
    uv : (n, 2), v up, or None
    reflectance_ratio : (n, 3), linear, without the texture
    texture : (h, w, 3) uint8 sRGB, or None; parts may share one
    is_unlit : whether it shows its colour whatever the light
    """

    world_from_part: Array
    vertices_m: Array
    faces: NDArray[np.int64]
    normals: Array | None
    uv: Array | None
    reflectance_ratio: Array
    texture: NDArray[np.uint8] | None
    is_unlit: bool


def read_parts(path: Path) -> list[Part]:
    """Return all triangles of a .glb or .gltf file.

    Raises
    ------
    ValueError
        No such file, no glTF 2, one that needs extensions not known here, damaged,
        without triangles, or too large.

    Notes
    -----
    Nothing is transparent: what the file blends with less than `LEAST_WEIGHT_RATIO`
    is left out, all else is opaque.  Skins, shape keys and animations rest.
    """
    header, data, kind = _numbered(path, _content(path))
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=kind,
            resolver=trimesh.resolvers.FilePathResolver(str(path)),
        )
    except Exception as error:  # whatever a damaged file leads a reader to
        raise ValueError(f"{path}: damaged, or files beside it are missing") from error
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    meshes = [(matrix, scene.geometry[name]) for matrix, name in placed]
    # Lines and points are no triangles; what a node squeezes flat has no inside.
    meshes = [
        (matrix, mesh)
        for matrix, mesh in meshes
        if isinstance(mesh, trimesh.Trimesh)
        and len(mesh.faces)
        and abs(np.linalg.det(matrix[:3, :3])) > LEAST_VOLUME_RATIO
    ]
    # Counted before any is copied: a file may place one mesh a thousand times.
    count = sum(len(mesh.faces) for _, mesh in meshes)
    if count > MAX_TRIANGLES:
        raise ValueError(f"{path}: {count} triangles; at most {MAX_TRIANGLES}")
    parts = list(_parts(meshes, header))
    if not parts:
        raise ValueError(f"{path}: no triangles to show")
    return parts


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    size_mb = path.stat().st_size / 1e6
    if size_mb > MAX_FILE_MB:
        raise ValueError(f"{path}: {size_mb:.0f} MB; at most {MAX_FILE_MB:.0f}")
    return path.read_bytes()


def _numbered(path: Path, content: bytes) -> tuple[dict, bytes, str]:
    """Return a file's header, the file with materials numbered, and its kind.

    trimesh rounds the colours of materials, and forgets which is unlit.  So each
    primitive gets a material of its own, whose name says where it stands in the header.
    """
    kind = "glb" if content.startswith(_MAGIC) else "gltf"
    try:
        text, rest = _split(content) if kind == "glb" else (content, b"")
        header = json.loads(text)
        version = header["asset"]["version"]
        numbered = json.dumps(_with_own_materials(header)).encode()
    except (ValueError, TypeError, LookupError, AttributeError, struct.error) as error:
        raise ValueError(f"{path}: not a glTF file") from error
    if not str(version).startswith("2."):
        raise ValueError(f"{path}: glTF {version}; needs glTF 2")
    for name in header.get("extensionsRequired", ()):
        if not name.startswith(_KNOWN_EXTENSIONS):
            raise ValueError(f"{path}: needs the extension {name}, not known here")
    return header, _joined(numbered, rest) if kind == "glb" else numbered, kind


def _split(content: bytes) -> tuple[bytes, bytes]:
    """Return the header's text and the chunks behind it of a binary file."""
    length, name = _CHUNK.unpack_from(content, _HEADER.size)
    start = _HEADER.size + _CHUNK.size
    if name != _JSON_CHUNK or start + length > len(content):
        raise ValueError("no header")
    return content[start : start + length], content[start + length :]


def _joined(text: bytes, rest: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    total = _HEADER.size + _CHUNK.size + len(text) + len(rest)
    start = _HEADER.pack(_MAGIC, 2, total) + _CHUNK.pack(len(text), _JSON_CHUNK)
    return start + text + rest


def _with_own_materials(header: dict) -> dict:
    """Return the header with one material for each primitive, named by its place."""
    materials, meshes = [], []
    for i, mesh in enumerate(header.get("meshes", [])):
        primitives = []
        for k, primitive in enumerate(mesh["primitives"]):
            primitives.append(primitive | {"material": len(materials)})
            materials.append(_material(header, primitive) | {"name": f"{i} {k}"})
        meshes.append(mesh | {"primitives": primitives})
    return header | {"materials": materials, "meshes": meshes}


def _material(header: dict, primitive: dict) -> dict:
    index = primitive.get("material")
    return {} if index is None else header["materials"][index]


def _parts(placed, header: dict) -> Iterator[Part]:
    """Yield what is visible of placed meshes [(matrix, mesh), ...]."""
    textures: dict[int, NDArray[np.uint8]] = {}
    for world_from_part, mesh in placed:
        i, k = map(int, mesh.visual.material.name.split())
        primitive = header["meshes"][i]["primitives"][k]
        material = _material(header, primitive)
        surface = material.get("pbrMetallicRoughness", {})
        factor = np.array(surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), float)
        if material.get("alphaMode") == "BLEND" and factor[3] < LEAST_WEIGHT_RATIO:
            continue
        has_normals = "NORMAL" in primitive["attributes"]
        uv, image = mesh.visual.uv, mesh.visual.material.baseColorTexture
        texture = None
        if uv is not None and image is not None:
            if id(image) not in textures:
                textures[id(image)] = np.asarray(image.convert("RGB"))
            texture = textures[id(image)]
        yield Part(
            world_from_part=world_from_part,
            vertices_m=np.asarray(mesh.vertices, float),
            faces=np.asarray(mesh.faces),
            normals=np.asarray(mesh.vertex_normals, float) if has_normals else None,
            uv=uv,
            reflectance_ratio=factor[:3] * _vertex_colors(mesh),
            texture=texture,
            is_unlit="KHR_materials_unlit" in material.get("extensions", {}),
        )


def _vertex_colors(mesh) -> Array:
    """Return the linear factor (n, 3) on each vertex; integers are shares of all."""
    colors = mesh.visual.vertex_attributes.get("color")
    if colors is None:
        return np.ones((len(mesh.vertices), 3))
    top = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0
    return np.asarray(colors, float)[:, :3] / top
