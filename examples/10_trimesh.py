"""trimesh: filter a mesh with the renderer of ocufilter, without pyrender.

    python examples/10_trimesh.py [mesh.stl]

Any mesh that trimesh loads becomes one batch of triangles.  Its colors, one per vertex,
contain the light.

Requires `pip install trimesh`.
"""

import sys

import numpy as np
import trimesh
from common import save_pictures

from clients.scene_renderer import SceneRenderer, look_at
from clients.scenes.geometry import Batch, Scene
from ocufilter import Camera, EyeFilter

SIZE_PX = (360, 270)
TO_LAMP = np.array([0.5, 0.7, 0.5])

mesh = (
    trimesh.load_mesh(sys.argv[1])
    if sys.argv[1:]
    else trimesh.creation.annulus(0.12, 0.3, 0.15)
)
mesh.apply_translation(-mesh.bounds.mean(axis=0))
mesh.apply_scale(0.5 / mesh.extents.max())  # half a meter across
mesh.unmerge_vertices()  # flat faces

light = 0.25 + 0.7 * np.clip(mesh.vertex_normals @ TO_LAMP, 0.0, 1.0)
batch = Batch(
    vertices_m=mesh.vertices.astype(np.float32),
    faces=mesh.faces.astype(np.uint32),
    uv=np.zeros((len(mesh.vertices), 2), np.float32),
    srgb=(light[:, None] * (0.9, 0.7, 0.5)).astype(np.float32),
    texture=None,
)
scene = Scene(
    name="mesh",
    batches=(batch,),
    background_srgb=(0.75, 0.8, 0.85),
    near_m=0.05,
    far_m=10.0,
    infinite_from_m=10.0,
)
with SceneRenderer(scene, SIZE_PX) as renderer:
    color, depth_m = renderer.render(look_at((0.3, 0.35, 0.7), (0.0, 0.0, 0.0)))
    camera = Camera(*SIZE_PX, renderer.tangents)

pictures = [("the mesh", color)]
with EyeFilter({"kind": "preset", "name": "emmetropia"}, camera) as eye:
    for focus_dpt in (1.2, 5.0):
        state = {"pupil_diameter_mm": 5.0, "focus_dpt": focus_dpt}
        seen = eye.filter(color, depth_m, **state, whole=True)
        pictures.append((f"focused at {focus_dpt:g} dpt", seen.color))
save_pictures("10_trimesh.png", pictures, columns=3)
