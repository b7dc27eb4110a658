"""pyrender: stream meshes to a service, as two kinds of cameras see them.

    python examples/09_pyrender.py

The meshes of trimesh stand at 0.4, 1 and 4 m.  pyrender renders color and depth off
screen.  The perspective camera has no far plane.  The other camera is given by its
intrinsics, like a depth camera, with a principal point outside of the center.  A
30-year-old looks from the nearest mesh to the farthest.

Requires `pip install 'ocufilter[pyrender]'`.
"""

import numpy as np
import trimesh
from common import save_pictures

from clients.frame_log import FrameLog
from clients.pyrender_renderer import pyrender, pyrender_frames
from clients.scene_renderer import Key, path_moments
from clients.streaming import filter_in_order
from ocufilter import FilterClient, ServiceProcess

SIZE_PX = (360, 200)
PERSON = {"kind": "preset", "name": "emmetropia", "age_years": 30}
CAMERAS = {
    "perspective": pyrender.PerspectiveCamera(yfov=np.deg2rad(30.0)),
    "intrinsics": pyrender.IntrinsicsCamera(fx=360.0, fy=360.0, cx=210.0, cy=80.0),
}
AHEAD = (0.0, 0.0, -1.0)
PATH = path_moments(
    (Key((0.0, 0.0, 0.0), AHEAD, 4.0, 0.4), Key((0.01, 0.0, 0.0), AHEAD, 5.0, 4.0)), 12
)

scene = pyrender.Scene(bg_color=(0.62, 0.7, 0.68, 1.0), ambient_light=(0.4, 0.4, 0.4))
scene.add(pyrender.DirectionalLight(intensity=4.0), pose=np.eye(4))
for mesh, rgb, place_m in (
    (trimesh.creation.box((0.06, 0.06, 0.06)), (200, 60, 40), (-0.08, 0.0, -0.4)),
    (trimesh.creation.icosphere(radius=0.08), (240, 220, 120), (0.0, 0.02, -1.0)),
    (trimesh.creation.torus(0.4, 0.15), (40, 90, 160), (1.0, 0.2, -4.0)),
):
    mesh.visual.face_colors = (*rgb, 255)
    node = pyrender.Mesh.from_trimesh(mesh, smooth=False)
    scene.add(node, pose=trimesh.transformations.translation_matrix(place_m))

pictures = []
with ServiceProcess() as service, FilterClient(service.endpoint) as client:
    for name, camera in CAMERAS.items():
        frames = list(pyrender_frames(scene, SIZE_PX, camera=camera, path=PATH))
        client.set_profile(PERSON, views=[frames[0].view])
        filtered = filter_in_order(client, frames, FrameLog())
        seen = [np.array(answer.color) for answer in filtered]  # the buffer is reused
        pictures += [
            (f"{name} camera", frames[0].color),
            ("looking at 0.4 m", seen[0]),
            ("looking at 4 m", seen[-1]),
        ]
print(f"{len(PATH)} frames of {len(scene.mesh_nodes)} meshes by each camera")
save_pictures("09_pyrender.png", pictures, columns=3)
