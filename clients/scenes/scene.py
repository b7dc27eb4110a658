"""A finished scene: triangles with baked light, ready for flat rendering."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.scenes.geometry import Array, Mesh, srgb_from_linear


@dataclass(frozen=True)
class Batch:
    """Triangles of one draw call.

    Attributes
    ----------
    vertices_m : (n, 3) float32, meters
    faces : (m, 3) uint32, counterclockwise as seen from the side of their normals
    uv : (n, 2) float32
    srgb : (n, 3) float32, sRGB-encoded light that leaves the vertex; with a texture,
        the factor on its sRGB values
    texture : (h, w, 3) uint8 sRGB, or None
    """

    vertices_m: NDArray[np.float32]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    srgb: NDArray[np.float32]
    texture: NDArray[np.uint8] | None


@dataclass(frozen=True)
class Scene:
    """Named batches, the background color and the camera's depth limits.

    Attributes
    ----------
    infinite_from_m : planar depth from which a surface counts as background (+inf)
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
        # A power law factors a product exactly; sRGB itself does not.
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
    """Return faces (m, 3), reversing those of mirrored parts to match their normals."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    normals = mesh.normals[mesh.faces].sum(axis=1)
    against = (np.cross(b - a, c - a) * normals).sum(axis=1) < 0.0
    return np.where(against[:, None], mesh.faces[:, ::-1], mesh.faces)
