"""Scenes for rendering: triangles with baked light."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.scenes.geometry import Array, Mesh, srgb_from_linear


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
        sRGB-encoded light of the vertices; with a texture, the factor on its values.
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
    """

    name: str
    batches: tuple[Batch, ...]
    background_srgb: tuple[float, float, float]
    near_m: float
    far_m: float
    infinite_from_m: float
    fov_deg: float = 50.0

    @property
    def n_triangles(self) -> int:
        """Return the number of triangles in all batches."""
        return sum(len(batch.faces) for batch in self.batches)


def finished(mesh: Mesh, light: Array, textures: dict[str, NDArray[np.uint8]]) -> Batch:
    """Convert a mesh and the light (n, 3) on its vertices to a draw call."""
    if mesh.texture:
        # The product of two powers is the power of the product, unlike with sRGB.
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


def _wound(mesh: Mesh) -> NDArray[np.int64]:
    """Return faces (m, 3) whose winding matches their normals after mirroring."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    normals = mesh.normals[mesh.faces].sum(axis=1)
    against = (np.cross(b - a, c - a) * normals).sum(axis=1) < 0.0
    return np.where(against[:, None], mesh.faces[:, ::-1], mesh.faces)
