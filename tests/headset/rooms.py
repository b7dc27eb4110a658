"""Scenes for tests, as glTF files: what is in them has a known place."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

WALL_M = 4.0


def stripes(path: Path, *, width_m: float = 12.0, n_stripes: int = 48) -> Path:
    """Write a wall of upright black and white stripes, `WALL_M` ahead of the origin.

    It is unlit, so that colors are those of its texture, and reaches far enough down
    and up that a viewer stands before its middle.
    """
    texels = np.zeros((8, 2 * n_stripes, 3), np.uint8)
    texels[:, ::2] = 255
    image = Image.fromarray(np.repeat(texels, 32, axis=1))
    half = width_m / 2
    corners = np.array(
        [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], float
    )
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    material = PBRMaterial(baseColorTexture=image, name="stripes")
    wall = trimesh.Trimesh(
        corners,
        [[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    path.write_bytes(trimesh.Scene(wall).export(file_type="glb"))
    return path
