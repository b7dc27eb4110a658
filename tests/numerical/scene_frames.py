"""Frames of the two scenes for tests and benchmarks, rendered in another process.

A renderer leaves no OpenGL context current, and the tests keep theirs current.
"""

import json
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from filter_service.rgbd_view import RgbdView

_SCRIPT = """
import json
import sys
from dataclasses import replace
import numpy as np
from clients.scene_renderer import PATHS, Key, SceneRenderer, path_moments
from clients.scenes.catalog import build_scene
name, width, height, count, first, end, keys, hidden, fov, out = sys.argv[1:]
scene = build_scene(name)
if float(fov):
    scene = replace(scene, fov_deg=float(fov))
path = [Key(*key) for key in json.loads(keys)] or PATHS[name]
moments = path_moments(path, int(count))[int(first) : int(end)]
with SceneRenderer(scene, (int(width), int(height))) as renderer:
    frames = [
        renderer.render_layers(moment.pose) if hidden == "hidden"
        else (renderer.render(moment.pose),)
        for moment in moments
    ]
    tangents = renderer.tangents
names = (("color", "depth_m"), ("hidden_color", "hidden_depth_m"))
np.savez(out, tangents=tangents, **{
    name: np.stack([frame[layer][part] for frame in frames])
    for layer in range(len(frames[0])) for part, name in enumerate(names[layer])
})
"""

SCENES = ("courtyard", "primitives")


@cache
def scene_view(
    name: str,
    *,
    width_px: int,
    height_px: int,
    with_hidden: bool = False,
    fov_deg: float | None = None,
) -> RgbdView:
    """Middle frame of a scene's own camera path; ``fov_deg``: vertical, if another."""
    size_px = width_px, height_px
    options = {"with_hidden": with_hidden, "fov_deg": fov_deg}
    return _rendered(name, *size_px, 5, 2, 3, **options)[0]


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
) -> tuple[RgbdView, ...]:
    """Frames of a camera path, the scene's own where it is empty.

    Parameters
    ----------
    path : tuple
        Arguments of `clients.scene_renderer.Key`.
    count, first, end : int
        Frames of the whole path, and which of them.
    """
    end = count if end is None else end
    return _rendered(name, width_px, height_px, count, first, end, path)


def _rendered(
    name,
    width_px,
    height_px,
    count,
    first,
    end,
    path=(),
    with_hidden=False,
    fov_deg=None,
) -> tuple:
    root = Path(__file__).parents[2]
    numbers = [str(n) for n in (width_px, height_px, count, first, end)]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "frames.npz"
        layers = "hidden" if with_hidden else "seen"
        fov = str(fov_deg or 0.0)
        arguments = [name, *numbers, json.dumps(path), layers, fov, str(out)]
        subprocess.run(
            [sys.executable, "-c", _SCRIPT, *arguments], check=True, cwd=root
        )
        with np.load(out) as data:
            tangents = tuple(float(t) for t in data["tangents"])
            images = {name: data[name] for name in data.files if name != "tangents"}
    return tuple(
        RgbdView(tangents=tangents, **{name: images[name][k] for name in images})
        for k in range(end - first)
    )
