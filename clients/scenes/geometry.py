"""Triangle meshes as plain arrays, and the basic shapes of the scenes.

Every scene uses OpenGL coordinates: meters, x right, y up, z toward the viewer.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Line = Array | Sequence[Array | Sequence[float]]  # points (n, 3)


class Look(TypedDict, total=False):
    """Texture and color of a shape, as for `new_mesh`."""

    color: str
    texture: str


@dataclass(frozen=True)
class Mesh:
    """Triangles that share one texture.

    Attributes
    ----------
    vertices_m : (n, 3) array
        Positions, in meters.
    normals : (n, 3) array
        Unit vectors.
    faces : (m, 3) array of int
        Vertex indices of the triangles.
    albedo : (n, 3) array
        Linear reflectance, 0 to 1, which multiplies the texture.
    emission : (n, 3) array
        Linear light that is added regardless of the lighting.
    translucency : (n,) array
        Fraction of light transmitted from behind, for leaves.
    uv : (n, 2) array
        Texture coordinates, v up.
    texture : str
        Name of the texture; empty for none.
    """

    vertices_m: Array
    normals: Array
    faces: NDArray[np.int64]
    albedo: Array
    emission: Array
    translucency: Array
    uv: Array
    texture: str = ""


def linear_from_hex(code: str) -> Array:
    """Return the linear RGB (3,) of an sRGB color written as "#rrggbb"."""
    return linear_from_srgb(
        np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    )


def linear_from_srgb(srgb: Array) -> Array:
    """Decode sRGB values 0..1 of any shape to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Array) -> Array:
    """Encode linear light of any shape, clipped to 0..1, as sRGB (IEC 61966-2-1)."""
    value = np.clip(linear, 0.0, 1.0)
    return np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055
    )


def new_mesh(
    vertices_m: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    color: str = "#ffffff",
    texture: str = "",
) -> Mesh:
    """Return a mesh of one color; compute its normals if none are given."""
    vertices_m = np.asarray(vertices_m, float).reshape(-1, 3)
    faces = np.asarray(faces, int).reshape(-1, 3)
    n = len(vertices_m)
    if normals is None:
        normals = vertex_normals(vertices_m, faces)
    return Mesh(
        vertices_m=vertices_m,
        normals=np.asarray(normals, float).reshape(-1, 3),
        faces=faces,
        albedo=np.tile(linear_from_hex(color), (n, 1)),
        emission=np.zeros((n, 3)),
        translucency=np.zeros(n),
        uv=np.zeros((n, 2)) if uv is None else np.asarray(uv, float).reshape(-1, 2),
        texture=texture,
    )


def vertex_normals(vertices_m: Array, faces: NDArray[np.int64]) -> Array:
    """Return the area-weighted unit normals (n, 3) of a mesh."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices_m)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    return unit(normals)


def unit(vectors: Array) -> Array:
    """Normalize vectors (..., 3) to length 1; zero vectors stay 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def painted(mesh: Mesh, color: str, *, emission: float = 0.0) -> Mesh:
    """Return the mesh in one color, which also emits `emission` times that color."""
    rgb = np.tile(linear_from_hex(color), (len(mesh.vertices_m), 1))
    return replace(mesh, albedo=rgb, emission=rgb * emission)


def transformed(mesh: Mesh, matrix: Array) -> Mesh:
    """Apply a (4, 4) matrix to a mesh; the matrix may scale axes differently."""
    linear = matrix[:3, :3]
    return replace(
        mesh,
        vertices_m=mesh.vertices_m @ linear.T + matrix[:3, 3],
        normals=unit(mesh.normals @ np.linalg.inv(linear)),
    )


def placed(
    mesh: Mesh,
    position_m: ArrayLike = (0, 0, 0),
    *,
    turn_deg: float = 0.0,
    scale: float = 1.0,
) -> Mesh:
    """Scale a mesh, rotate it about the vertical axis and move it."""
    matrix = rotation("y", turn_deg)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = position_m
    return transformed(mesh, matrix)


def rotation(axis: str, angle_deg: float) -> Array:
    """Return a (4, 4) right-handed rotation about "x", "y" or "z"."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes with one texture into one mesh."""
    textures = {mesh.texture for mesh in meshes}
    if len(textures) != 1:
        raise ValueError(
            f"meshes have the textures {sorted(textures)}; expected exactly one"
        )
    offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, offsets, strict=True)]
    names = [f.name for f in fields(Mesh) if f.name not in ("faces", "texture")]
    return Mesh(
        faces=np.concatenate(faces),
        texture=meshes[0].texture,
        **{k: np.concatenate([getattr(m, k) for m in meshes]) for k in names},
    )


def by_texture(meshes: Sequence[Mesh]) -> list[Mesh]:
    """Merge the meshes of each texture, so that a frame takes few draw calls."""
    names = sorted({mesh.texture for mesh in meshes})
    return [merged([m for m in meshes if m.texture == name]) for name in names]


def patch(
    origin_m: ArrayLike,
    side_u_m: ArrayLike,
    side_v_m: ArrayLike,
    *,
    cells: tuple[int, int] = (1, 1),
    uv_scale: tuple[float, float] = (1, 1),
    **look: Unpack[Look],
) -> Mesh:
    """Return a flat parallelogram with the normal side_u × side_v."""
    nu, nv = cells
    grid = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1))
    u, v = (values.ravel() for values in grid)
    side_u_m, side_v_m = np.asarray(side_u_m, float), np.asarray(side_v_m, float)
    vertices = np.asarray(origin_m, float) + np.outer(u, side_u_m)
    vertices = vertices + np.outer(v, side_v_m)
    normal = np.cross(side_u_m, side_v_m)
    normals = np.tile(normal / np.linalg.norm(normal), (len(u), 1))
    uv = np.stack([u * uv_scale[0], v * uv_scale[1]], axis=1)
    return new_mesh(vertices, grid_faces(nv, nu), normals=normals, uv=uv, **look)


def grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return the triangles of a (rows+1) × (columns+1) grid of vertices."""
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    first = (r * (columns + 1) + c).ravel()
    up = first + columns + 1
    lower = np.stack([first, first + 1, up + 1], axis=1)
    return np.concatenate([lower, np.stack([first, up + 1, up], axis=1)])


def box(size_m: ArrayLike, *, cells: int = 1, **look: Unpack[Look]) -> Mesh:
    """Return a box centered on the origin, with cells × cells squares per face."""
    sides = []
    half = np.asarray(size_m, float) / 2
    for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
        u, v = (
            2 * half * np.eye(3)[(axis + shift) % 3] for shift in (1, 2)[:: int(sign)]
        )
        origin = np.where(np.arange(3) == axis, sign * half, -half)
        sides.append(patch(origin, u, v, cells=(cells, cells), **look))
    return merged(sides)


def block(size_m: ArrayLike, center_m: ArrayLike, **look: Unpack[Look]) -> Mesh:
    """Return a box centered on a point."""
    return placed(box(size_m, **look), center_m)


def lathe(profile_m: ArrayLike, *, sides: int = 20, **look: Unpack[Look]) -> Mesh:
    """Revolve a profile of (radius, height) points, bottom first, about the y axis."""
    profile_m = np.asarray(profile_m, float)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    up = np.array([0.0, 1.0, 0.0])
    vertices = profile_m[:, None, :1] * ring + profile_m[:, None, 1:] * up
    slope = unit(np.asarray(np.gradient(profile_m, axis=0)))
    normals = slope[:, None, 1:] * ring - slope[:, None, :1] * up
    v = np.linspace(0, 1, len(profile_m))
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), v[:, None]), axis=-1)
    faces = grid_faces(len(profile_m) - 1, sides)
    return new_mesh(vertices, faces, normals=normals, uv=uv, **look)


def sphere(radius_m: float, *, sides: int = 12, **look: Unpack[Look]) -> Mesh:
    """Return a sphere centered on the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    profile = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return lathe(profile, sides=sides, **look)


def tube(
    path_m: Line, radius_m: ArrayLike, *, sides: int = 6, **look: Unpack[Look]
) -> Mesh:
    """Return a round bar along a path (n, 3); its radius is one number or (n,)."""
    path_m = np.asarray(path_m, float)
    radius_m = np.broadcast_to(np.asarray(radius_m, float), len(path_m))
    along = unit(np.asarray(np.gradient(path_m, axis=0)))
    # A single helper direction keeps the rings of the bar from twisting.
    helper = np.eye(3)[np.argmin(np.abs(along).mean(axis=0))]
    across = unit(np.cross(along, helper))
    third = np.cross(along, across)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    normals = np.cos(angle) * across[:, None] + np.sin(angle) * third[:, None]
    vertices = path_m[:, None] + radius_m[:, None, None] * normals
    faces = grid_faces(len(path_m) - 1, sides)
    return new_mesh(vertices, faces, normals=normals, **look)


# Scenes: triangles with baked light


@dataclass(frozen=True)
class Batch:
    """Triangles of one draw call.

    Attributes
    ----------
    vertices_m : (n, 3) float32
        Positions, in meters.
    faces : (m, 3) uint32
        Vertex indices, counterclockwise as seen from the side of the normals.
    uv : (n, 2) float32
        Texture coordinates.
    srgb : (n, 3) float32
        sRGB-encoded light of the vertices, multiplied by the texture, if there is one.
    texture : (h, w, 3) uint8 or None
        sRGB.
    """

    vertices_m: NDArray[np.float32]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    srgb: NDArray[np.float32]
    texture: NDArray[np.uint8] | None


@dataclass(frozen=True)
class Scene:
    """Triangles, background color and depth limits of a scene.

    Attributes
    ----------
    name : str
        Name of the scene.
    batches : tuple of Batch
        Draw calls.
    background_srgb : (float, float, float)
        Background color, 0 to 1.
    near_m, far_m : float
        Near and far plane of the camera.
    infinite_from_m : float
        Planar depth from which a surface counts as background, at infinity.
    fov_deg : float
        Vertical field of view.
    is_hdr : bool
        Whether lamps are brighter than white (`luminous`); only linear images show
        them.
    """

    name: str
    batches: tuple[Batch, ...]
    background_srgb: tuple[float, float, float]
    near_m: float
    far_m: float
    infinite_from_m: float
    fov_deg: float = 50.0
    is_hdr: bool = False

    @property
    def n_triangles(self) -> int:
        """Return the number of triangles in all batches."""
        return sum(len(batch.faces) for batch in self.batches)


def finished(mesh: Mesh, light: Array, textures: dict[str, NDArray[np.uint8]]) -> Batch:
    """Convert a mesh and the light (n, 3) on its vertices to a draw call."""
    if mesh.texture:
        # A power law is multiplicative; the sRGB curve is not.
        srgb = np.maximum(mesh.albedo * light + mesh.emission, 0.0) ** (1 / 2.2)
    else:
        srgb = srgb_from_linear(mesh.albedo * light + mesh.emission)
    return Batch(
        vertices_m=mesh.vertices_m.astype(np.float32),
        faces=_wound(mesh).astype(np.uint32),
        uv=mesh.uv.astype(np.float32),
        srgb=srgb.astype(np.float32),
        texture=textures[mesh.texture] if mesh.texture else None,
    )


def luminous(mesh: Mesh) -> Batch:
    """Convert a mesh without texture to a draw call of its emission.

    Light above 1 continues the sRGB curve, which linear images undo.
    """
    light = np.maximum(mesh.emission, 0.0)
    srgb = np.where(
        light <= 1.0, srgb_from_linear(light), 1.055 * light ** (1 / 2.4) - 0.055
    )
    unlit = finished(mesh, np.zeros_like(mesh.emission), {})
    return replace(unlit, srgb=srgb.astype(np.float32))


def _wound(mesh: Mesh) -> NDArray[np.int64]:
    """Return faces (m, 3) whose winding matches their normals after mirroring."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    normals = mesh.normals[mesh.faces].sum(axis=1)
    against = (np.cross(b - a, c - a) * normals).sum(axis=1) < 0.0
    return np.where(against[:, None], mesh.faces[:, ::-1], mesh.faces)
