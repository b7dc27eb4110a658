"""Frames of the two scenes for tests and benchmarks, rendered in a process apart.

pyrender ends the EGL display when it closes, and with it any other context of the same
process; the service and its clients never share one.
"""

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from filter_service.rendering.frame import View

_SCRIPT = """
import sys
import numpy as np
from clients.scene_renderer import scene_frames
from clients.scenes import courtyard, primitives
name, width, height, count, index, hidden, out = sys.argv[1:]
scene = {"courtyard": courtyard, "primitives": primitives}[name].build()
size = (int(width), int(height))
frames = scene_frames(scene, None, int(count), size, with_hidden=hidden == "hidden")
frame = list(frames)[int(index)]
names = ("color", "depth_m", "tangents", "hidden_color", "hidden_depth_m")
images = {name: getattr(frame, name) for name in names}
np.savez(out, **{name: image for name, image in images.items() if image is not None})
"""

SCENES = ("courtyard", "primitives")


@cache
def scene_view(
    name: str, *, width_px: int, height_px: int, with_hidden: bool = False
) -> View:
    """Middle frame of a scene's own camera path."""
    root = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "frame.npz"
        arguments = [name, str(width_px), str(height_px), "5", "2"]
        arguments += ["hidden" if with_hidden else "seen", str(out)]
        subprocess.run(
            [sys.executable, "-c", _SCRIPT, *arguments], check=True, cwd=root
        )
        with np.load(out) as data:
            hidden = ("hidden_color", "hidden_depth_m")
            return View(
                data["color"],
                data["depth_m"],
                tuple(float(t) for t in data["tangents"]),
                **{name: data[name] for name in hidden if name in data},
            )
