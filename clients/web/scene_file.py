"""Rendering of a scene in a child process.

    python -m clients.web.scene_file courtyard out.npz 960x540

Building a scene takes seconds, during which the page must stay responsive.
"""

from __future__ import annotations

import struct
import subprocess
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from clients.commands.options import read_size_px
from clients.headset.gltf_file import (
    MAX_HEADER_BYTES,
    MAX_HEADER_DEPTH,
    MAX_HEADER_ITEMS,
)
from clients.web.picture import Picture, picture_of
from estimator import InvalidFile
from estimator.bounded_files import loads_bounded
from filter_service import RgbdView
from filter_service.atomic_files import replace_atomically

TIMEOUT_S = 300.0
SIZE_PX = (960, 540)
GLTF_SUFFIXES = (".glb", ".gltf")
MAX_GLTF_BYTES = 200_000_000
_GLB_HEADER = struct.Struct("<4sIIII")
TITLES = {"courtyard": "Courtyard", "primitives": "Primitives"}
_CHECKOUT = Path(__file__).resolve().parents[2]
# In a checkout, `-m` requires this folder; installed packages need none.
_FOLDER = _CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None


_SCENES: dict[str, Picture] = {}
_SCENES_LOCK = threading.Lock()


class SceneNotRendered(Exception):
    """Raised when a scene cannot be rendered; the message gives the reason."""


@cache
def scene_picture(name: str) -> Picture:
    """Return a built-in scene as a picture; only the first call takes seconds.

    Raises
    ------
    SceneNotRendered
    """
    with _SCENES_LOCK:
        if name not in _SCENES:
            with tempfile.TemporaryDirectory(prefix="ocufilter-") as folder:
                _SCENES[name] = _rendered(name, TITLES[name], Path(folder))
        return _SCENES[name]


def gltf_picture(name: str, content: bytes) -> Picture:
    """Return a glTF file as a picture.

    Raises
    ------
    InvalidFile
        If the file is of another kind, or refers to other files.
    SceneNotRendered
        If the file is damaged or cannot be rendered here.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in GLTF_SUFFIXES:
        allowed = f"{', '.join(GLTF_SUFFIXES)} with embedded textures and meshes"
        raise InvalidFile(name[:60], "not a scene", allowed)
    _check_is_self_contained(name, content)
    with tempfile.TemporaryDirectory(prefix="ocufilter-") as folder:
        path = Path(folder) / f"scene{suffix}"
        path.write_bytes(content)
        try:
            return _rendered(str(path), Path(name).name[:60], Path(folder))
        except SceneNotRendered as error:
            raise SceneNotRendered(
                str(error).replace(str(path), Path(name).name)
            ) from None


def _check_is_self_contained(name: str, content: bytes) -> None:
    """Reject a glTF file that references other files, which would be on the server.

    The reader checks whether the file is valid.
    """
    text = content
    if content.startswith(b"glTF") and len(content) >= _GLB_HEADER.size:
        length = _GLB_HEADER.unpack_from(content)[3]
        text = content[_GLB_HEADER.size :][:length]
    try:
        header = loads_bounded(
            text,
            max_bytes=MAX_HEADER_BYTES,
            max_depth=MAX_HEADER_DEPTH,
            max_items=MAX_HEADER_ITEMS,
        )
    except ValueError as error:
        found = f"is not a glTF 2 file ({error})"
        raise InvalidFile(name[:60], found, "glTF 2") from None
    for uri in _uris(header):
        if not uri.startswith("data:"):
            allowed = ".glb, or .gltf with embedded textures and meshes"
            raise InvalidFile(
                name[:60], f"refers to another file, '{uri:.60}'", allowed
            )


def _uris(part: object) -> list[str]:
    """Return all URIs in the header of a glTF file, at any depth."""
    if isinstance(part, list):
        return [uri for each in part for uri in _uris(each)]
    if not isinstance(part, dict):
        return []
    own = part.get("uri")
    return [str(own)] * (own is not None) + _uris(list(part.values()))


def _rendered(source: str, title: str, folder: Path) -> Picture:
    file = folder / "rendered.npz"
    size = "{}x{}".format(*SIZE_PX)
    command = [sys.executable, "-m", "clients.web.scene_file", source, str(file), size]
    try:
        done = subprocess.run(
            command,
            cwd=_FOLDER,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        raise SceneNotRendered(
            f"{title}: rendering timed out after {TIMEOUT_S:.0f} s"
        ) from None
    if not file.is_file():
        lines = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        raise SceneNotRendered(lines[-1])
    with np.load(file) as arrays:
        state = arrays["state"]
        view = RgbdView(
            arrays["color"],
            arrays["depth_m"],
            tuple(arrays["tangents"].tolist()),
            hidden_color=arrays["hidden_color"],
            hidden_depth_m=arrays["hidden_depth_m"],
        )
    if not len(state):
        return picture_of(title, view)
    pupil_mm, focus_dpt = state.tolist()
    return picture_of(title, view, focus_dpt=focus_dpt, pupil_diameter_mm=pupil_mm)


def main(source: str, file: str, size: str) -> int:
    """Render a scene and write it to a file, in the child process."""
    from clients.headset.gltf_scene import load_gltf
    from clients.headset.scenery import viewpoint
    from clients.scene_renderer import PATHS, SceneRenderer, path_moments
    from clients.scenes.catalog import build_scene

    try:
        is_built_in = source in PATHS
        scene = build_scene(source) if is_built_in else load_gltf(source)
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    state: tuple[float, ...] = ()
    if is_built_in:
        (moment,) = path_moments(PATHS[source], 1)
        state = (moment.pupil_diameter_mm, moment.focus_dpt)
    with SceneRenderer(scene, read_size_px(size)) as renderer:
        seen, hidden = renderer.render_layers(viewpoint(scene))
        arrays: dict[str, Any] = {
            "color": seen[0],
            "depth_m": seen[1],
            "hidden_color": hidden[0],
            "hidden_depth_m": hidden[1],
            "tangents": renderer.tangents,
            "state": state,
        }
    replace_atomically(Path(file), lambda part: np.savez(part, **arrays))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
