"""An empty environment with the wheel: how to create it, and to run commands in it."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.release.commands import TOOLS, Failed

INDEX_SETTINGS = ("PIP_", "UV_", "SSL_CERT", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY")
LEADS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
ENTER = """
mount --rbind /dev "$1/dev" && mount -t proc proc "$1/proc" || exit
root=$1 folder=$2
shift 2
exec chroot "$root" env -C "$folder" "$@"
"""


@dataclass(frozen=True)
class Python:
    """An interpreter, of this system or of another one in a folder (a chroot).

    Attributes
    ----------
    version : str
        Such as ``3.12``.
    path : str
        Within the system that it belongs to.
    root : Path or None
        Folder of the other system.
    """

    version: str
    path: str
    root: Path | None = None


class Environment:
    """A virtual environment, and an empty folder in which its commands run."""

    def __init__(self, python: Python, folder: Path):
        self.python = python
        if python.root:
            folder = python.root / "tmp" / "release" / folder.name
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        self.work = folder / "work"
        self.work.mkdir(parents=True)
        (folder / "home").mkdir()
        if python.root:
            shutil.copyfile(TOOLS / "uv", folder / "uv")
            (folder / "uv").chmod(0o755)
        self._uv("venv", "--quiet", "--python", python.path, self.inside("venv"))

    def inside(self, name: str) -> str:
        """Return a path in the folder of this environment as its commands see it."""
        path = self.folder / name
        return (
            f"/{path.relative_to(self.python.root)}" if self.python.root else str(path)
        )

    def install(self, wheel: Path, *oldest: str, extra: str = "") -> None:
        """Install a wheel, with the oldest versions of ``oldest`` and newest others."""
        shutil.copy2(wheel, self.folder)
        options = ["--only-binary", ":all:", "--python", self.inside("venv/bin/python")]
        if oldest:
            options += ["--resolution", "lowest-direct"]
        package = self.inside(wheel.name) + (f"[{extra}]" if extra else "")
        self._uv("pip", "install", "--quiet", *options, package, *oldest)

    def versions(self) -> dict[str, str]:
        """Return the version of each installed package."""
        listing = self._uv(
            "pip", "freeze", "--quiet", "--python", self.inside("venv/bin/python")
        )
        return dict(line.split("==") for line in listing.split() if "==" in line)

    def size_mb(self) -> float:
        """Return the size of the installed packages without compiled bytecode."""
        (site,) = self.folder.glob("venv/lib/python*/site-packages")
        files = (path for path in site.rglob("*") if "__pycache__" not in path.parts)
        return sum(path.lstat().st_size for path in files if path.is_file()) / 1e6

    def remove(self) -> None:
        """Delete the environment and the folder."""
        shutil.rmtree(self.folder)

    def run(self, command: str, *arguments: str, timeout_s: float = 900.0) -> str:
        """Run a program of the environment; return its standard output.

        Raises
        ------
        Failed
            With the last lines of its output.
        """
        process = self.start(command, *arguments)
        try:
            out, errors = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise Failed(
                f"{command} {arguments[:1]}: no end in {timeout_s} s"
            ) from None
        if process.returncode != 0:
            said = "\n  ".join((out + errors).strip().splitlines()[-20:])
            words = " ".join((command, *arguments[:2])).partition("\n")[0]
            raise Failed(f"{words}: exit status {process.returncode}:\n  {said}")
        return out

    def start(self, command: str, *arguments: str) -> subprocess.Popen[str]:
        """Start a program of the environment in the empty folder."""
        program = self.inside(f"venv/bin/{command}")
        return self._start([program, *arguments], self._environment())

    def _uv(self, *arguments: str) -> str:
        uv = self.inside("uv") if self.python.root else str(TOOLS / "uv")
        kept = {k: v for k, v in os.environ.items() if k.startswith(INDEX_SETTINGS)}
        # Copies, so that removing an environment gives back its space.
        kept |= {"UV_LINK_MODE": "copy", "UV_NO_PROGRESS": "1", "UV_NO_CONFIG": "1"}
        if self.python.root:
            kept["UV_CACHE_DIR"] = "/var/cache/uv"
        command = [uv, *map(str, arguments)]
        process = self._start(command, self._environment() | kept)
        out, errors = process.communicate()
        if process.returncode != 0:
            raise Failed(f"uv {' '.join(map(str, arguments))}\n  {errors.strip()}")
        return out

    def _environment(self) -> dict[str, str]:
        given = {k: v for k, v in os.environ.items() if k not in LEADS}
        return given | {
            "HOME": self.inside("home"),
            "XDG_CACHE_HOME": self.inside("home"),
        }

    def _start(self, command, environment) -> subprocess.Popen[str]:
        if self.python.root:
            enter = ["unshare", "--mount", "sh", "-c", ENTER, "sh"]
            command = [*enter, str(self.python.root), self.inside("work"), *command]
        else:
            # uv's cache is shared between environments of this system.
            cache = Path.home() / ".cache" / "uv"
            environment = {"UV_CACHE_DIR": str(cache), **environment}
        return subprocess.Popen(
            command,
            cwd=self.work,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
