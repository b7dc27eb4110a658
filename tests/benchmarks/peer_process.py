"""Peers that run as separate processes in an environment of their own.

optiland and DeepLens need packages that the project does not use (VTK, torch and, for
DeepLens, Python 3.12), so `sh setup.sh peers` installs them into ``.peers``.  A script
there answers one request a line; pictures travel as files.  The process waits while
other methods run, and it measures its own times, so that exchanging files costs it
nothing.
"""

import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.harness import ROOT
from tests.benchmarks.peer_problem import NotInstalled

PYTHON = ROOT / ".peers" / "bin" / "python"


def require(package: str) -> None:
    """Raise `NotInstalled` unless the environment of the peers has a package."""
    if peer_versions([package])[package] is None:
        raise NotInstalled(f"{package} (sh setup.sh peers)")


class PeerProcess:
    """A script that answers requests (`peer_answers`), one after the other.

    Parameters
    ----------
    script : Path
    """

    def __init__(self, script: Path):
        self._folder = tempfile.TemporaryDirectory()
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (see `close`)
        self._process = subprocess.Popen(
            (PYTHON, script),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )

    def ask(self, task: str, **arguments) -> dict:
        """Return the answer to a request.

        Raises
        ------
        RuntimeError
            The script failed; the message ends with what it wrote to stderr.
        """
        line = json.dumps({"task": task, "folder": self._folder.name, **arguments})
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._process.wait()
            self._errors.seek(0)
            raise RuntimeError(f"{task}: {self._errors.read()[-2000:]}")
        return json.loads(answer)

    def write(self, name: str, values: NDArray) -> None:
        """Write an array for the script to read."""
        np.save(Path(self._folder.name) / name, values)

    def read(self, name: str) -> NDArray:
        """Read an array that the script wrote."""
        return np.load(Path(self._folder.name) / name)

    def close(self) -> None:
        """End the script and delete its files."""
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._errors.close()
        self._folder.cleanup()


class PeerFrames:
    """The frames of a script: a function of states.

    Parameters
    ----------
    script : Path
    package : str
        What the script needs; raises `NotInstalled` without it.
    arrays, opening : dict
        Files that the script reads, and the arguments of its task "open".
    arguments : callable
        From a state to the arguments of its task "frame".

    Attributes
    ----------
    own_ms : float
        Of the last frame, without the exchange of files.
    """

    def __init__(self, script: Path, package: str, arrays, opening, arguments):
        require(package)
        self._arguments, self.own_ms = arguments, 0.0
        self._process = PeerProcess(script)
        for name, values in arrays.items():
            self._process.write(name, values)
        self._process.ask("open", **opening)

    def __call__(self, state) -> NDArray:
        """Filter the picture in a state."""
        answer = self._process.ask("frame", **self._arguments(state))
        self.own_ms = 1e3 * answer["seconds"]
        return self._process.read("out.npy")

    def close(self) -> None:
        """End the script."""
        self._process.close()


def peer_versions(packages) -> dict[str, str | None]:
    """Return versions of packages in the environment; None if missing."""
    if not PYTHON.exists():
        return dict.fromkeys(packages)
    script = (
        "import importlib.metadata as m, json, sys\n"
        "have = {d.metadata['Name']: d.version for d in m.distributions()}\n"
        "print(json.dumps({name: have.get(name) for name in sys.argv[1:]}))"
    )
    answer = subprocess.run(
        (PYTHON, "-c", script, *packages), check=True, capture_output=True, text=True
    )
    return json.loads(answer.stdout)
