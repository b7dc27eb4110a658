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
name, width, height, count, index, out = sys.argv[1:]
scene = {"courtyard": courtyard, "primitives": primitives}[name].build()
frames = scene_frames(scene, None, int(count), (int(width), int(height)))
frame = list(frames)[int(index)]
np.savez(out, color=frame.color, depth_m=frame.depth_m, tangents=frame.tangents)
"""

SCENES = ("courtyard", "primitives")


@cache
def scene_view(name: str, *, width_px: int, height_px: int) -> View:
    """Middle frame of a scene's own camera path."""
    root = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "frame.npz"
        arguments = [name, str(width_px), str(height_px), "5", "2", str(out)]
        subprocess.run(
            [sys.executable, "-c", _SCRIPT, *arguments], check=True, cwd=root
        )
        with np.load(out) as data:
            return View(
                data["color"],
                data["depth_m"],
                tuple(float(t) for t in data["tangents"]),
            )
