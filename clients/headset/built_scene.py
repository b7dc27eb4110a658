"""Built-in scenes, built in a child process.

Their lighting is baked with pyrender, whose OpenGL cannot share a process with
OpenXR's.
"""

import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import cast

from clients.batch.atomic_files import write_whole
from clients.extra import what_to_install
from clients.scenes.paths import PATHS
from clients.scenes.scene import Scene

TIMEOUT_S = 300.0
_CHECKOUT = Path(__file__).resolve().parents[2]
# From the checkout `-m` finds our packages; installed packages are found anyway.
_FOLDER = _CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None


class SceneNotBuilt(Exception):
    """The process that builds a scene failed; the message says why."""


def built_scene(name: str) -> Scene:
    """Build a scene without loading pyrender or PyOpenGL into this process.

    Raises
    ------
    ValueError
        No scene has that name.
    SceneNotBuilt
        A package is missing (the message says how to install it), or OpenGL failed.
    """
    if name not in PATHS:
        raise ValueError(f"scene {name!r} is unknown; choose from {sorted(PATHS)}")
    with tempfile.TemporaryDirectory(prefix="ocufilter-") as folder:
        file = Path(folder) / "scene"
        command = [sys.executable, "-m", "clients.headset.built_scene", name, str(file)]
        try:
            done = subprocess.run(
                command,
                cwd=_FOLDER,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                timeout=TIMEOUT_S,
            )
        except subprocess.TimeoutExpired as error:
            raise SceneNotBuilt(f"{name}: not built in {TIMEOUT_S:.0f} s") from error
        if not file.is_file():
            lines = done.stderr.strip().splitlines() or [
                f"ended with {done.returncode}"
            ]
            raise SceneNotBuilt(f"scene {name!r}: {lines[-1]}")
        return pickle.loads(file.read_bytes())  # of our own child


def main(name: str, file: str) -> None:
    """Build a scene and write it to a file, in the child process."""
    try:
        from clients.scenes.catalog import build_scene
    except ModuleNotFoundError as error:
        sys.exit(what_to_install(error))
    content = pickle.dumps(build_scene(name))
    write_whole(
        Path(file),
        cast("Callable[[Path], None]", lambda part: part.write_bytes(content)),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
