"""Child processes of a release: output is shown only if a command fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "release"
TOOLS = ROOT / ".release" / "bin"


class Failed(Exception):
    """A step of the release failed."""


def say(text: str) -> None:
    """Print progress to standard error."""
    print(f"release: {text}", file=sys.stderr, flush=True)


def run(*command, cwd=ROOT, timeout_s=900.0, **environment) -> str:
    """Run a command; return its standard output.

    Raises
    ------
    Failed
        With the last lines of its output.
    """
    words = [str(word) for word in command]
    finished = subprocess.run(
        words,
        cwd=cwd,
        env={**os.environ, **{k: str(v) for k, v in environment.items()}},
        capture_output=True,
        text=True,
        timeout=timeout_s,
    )
    if finished.returncode != 0:
        lines = (finished.stdout + finished.stderr).strip().splitlines()[-20:]
        said = "\n  ".join(lines)
        raise Failed(f"{' '.join(words)}\nexit status {finished.returncode}:\n  {said}")
    return finished.stdout
