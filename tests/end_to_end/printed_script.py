"""Runs what a page prints, in another folder, as its reader would."""

import os
import subprocess
import sys

from tests.source_tree import ROOT

LIMIT_S = 240


def printed_by(*arguments, cwd):
    """What Python prints for these arguments; it must end well."""
    finished = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout
