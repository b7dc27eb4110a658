"""One of our own scenes, built in a process apart.

Their light is baked with pyrender, whose OpenGL and OpenXR's cannot share a process.
"""

import pickle
import subprocess
import sys
import tempfile
from pathlib import Path

from clients.batch.whole_files import write_whole
from clients.extra import what_to_install
from clients.scenes.paths import PATHS
from clients.scenes.scene import Scene

TIMEOUT_S = 300.0
_CHECKOUT = Path(__file__).resolve().parents[2]
# There `-m` finds our packages whatever the folder; installed ones are found anyway.
_FOLDER = _CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None


class SceneNotBuilt(Exception):
    """The process that builds a scene has failed; the text says why."""


def built_scene(name: str) -> Scene:
    """Build a scene, with nothing of pyrender or PyOpenGL in this process.

    Raises
    ------
    ValueError
        No scene has that name.
    SceneNotBuilt
        A package is missing, which the text says how to install, or OpenGL failed.
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
    """Build a scene and write it to a file; that is the child's part."""
    try:
        from clients.scenes.catalogue import build_scene
    except ModuleNotFoundError as error:
        sys.exit(what_to_install(error))
    content = pickle.dumps(build_scene(name))
    write_whole(Path(file), lambda part: part.write_bytes(content))


if __name__ == "__main__":
    main(*sys.argv[1:])
