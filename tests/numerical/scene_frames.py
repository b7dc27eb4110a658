"""Frames of the two scenes for tests and benchmarks, rendered in a process apart.

pyrender ends the EGL display when it closes, and with it any other context of the same
process; the service and its clients never share one.
"""

import json
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from filter_service.rendering.frame import View

_SCRIPT = """
import json
import sys
import numpy as np
from clients.scene_renderer import SceneRenderer
from clients.scenes import courtyard, primitives
from clients.scenes.paths import PATHS, Key, path_moments
name, width, height, count, first, end, keys, out = sys.argv[1:]
scene = {"courtyard": courtyard, "primitives": primitives}[name].build()
path = [Key(*key) for key in json.loads(keys)] or PATHS[name]
moments = path_moments(path, int(count))[int(first) : int(end)]
with SceneRenderer(scene, (int(width), int(height))) as renderer:
    colors, depths = zip(*(renderer.render(moment.pose) for moment in moments))
    tangents = renderer.tangents
np.savez(out, color=np.stack(colors), depth_m=np.stack(depths), tangents=tangents)
"""

SCENES = ("courtyard", "primitives")


@cache
def scene_view(name: str, *, width_px: int, height_px: int) -> View:
    """Middle frame of a scene's own camera path."""
    return _rendered(name, width_px, height_px, 5, 2, 3)[0]


@cache
def scene_views(
    name: str,
    *,
    width_px: int,
    height_px: int,
    count: int,
    path: tuple = (),
    first: int = 0,
    end: int | None = None,
) -> tuple[View, ...]:
    """Frames of a camera path, the scene's own where it is empty.

    Parameters
    ----------
    path : tuple
        Arguments of `clients.scenes.paths.Key`.
    count, first, end : int
        Frames of the whole path, and which of them.
    """
    end = count if end is None else end
    return _rendered(name, width_px, height_px, count, first, end, path)


def _rendered(name, width_px, height_px, count, first, end, path=()) -> tuple:
    root = Path(__file__).parents[2]
    numbers = [str(n) for n in (width_px, height_px, count, first, end)]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "frames.npz"
        arguments = [name, *numbers, json.dumps(path), str(out)]
        subprocess.run(
            [sys.executable, "-c", _SCRIPT, *arguments], check=True, cwd=root
        )
        with np.load(out) as data:
            tangents = tuple(float(t) for t in data["tangents"])
            return tuple(
                View(color, depth_m, tangents)
                for color, depth_m in zip(data["color"], data["depth_m"], strict=True)
            )
