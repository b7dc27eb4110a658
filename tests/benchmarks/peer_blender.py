"""Blender's compositor among the peers, where a program ``blender`` is on the path."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.peer_problem import NotInstalled, Problem
from tests.benchmarks.view_sources import EyeState

SCRIPT = Path(__file__).with_name("peer_blender_script.py")
PROBE_SIZES = (4.0, 12.0)


class BlenderBlur:
    """A blur node that takes its radius from an image.

    Attributes
    ----------
    own_ms : float
        Of the last frame: compositing, and writing its file; not Blender's start.
    """

    def __init__(self, program: str, mode: str, problem: Problem):
        self._program, self._mode, self._problem = program, mode, problem
        self._size_per_px = self._measured_size_per_px()
        self.own_ms = 0.0

    def __call__(self, state: EyeState) -> NDArray:
        """Filter the problem's view with the discs of green light."""
        problem = self._problem
        radius_px = problem.disc_radius_px(state, problem.distance_dpt)
        jobs = [(problem.color, self._size_per_px * radius_px)]
        (color,), (seconds,) = self._run(jobs)
        self.own_ms = 1e3 * seconds
        return color

    def _measured_size_per_px(self) -> float:
        """Size to ask for by radius: versions take px, or parts of the image."""
        height, width = self._problem.color.shape[:2]
        point = np.zeros((height, width, 3), np.float32)
        point[height // 2, width // 2] = 1.0
        jobs = [(point, np.full((height, width), size)) for size in PROBE_SIZES]
        seen, _ = self._run(jobs)
        # a disc of unit light
        radii_px = [
            (np.pi * float(np.median(s[s > s.max() / 2]))) ** -0.5 for s in seen
        ]
        return (PROBE_SIZES[1] - PROBE_SIZES[0]) / (radii_px[1] - radii_px[0])

    def _run(self, jobs: list[tuple[NDArray, NDArray]]):
        """Pictures, and seconds, of (linear light, size) jobs."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for k, (color, size) in enumerate(jobs):
                opaque = np.ones((*size.shape, 1), np.float32)
                rgba = np.concatenate([color, opaque], axis=-1)
                np.save(folder / f"color_{k}.npy", rgba)
                np.save(folder / f"radius_{k}.npy", size.astype(np.float32))
            command = (self._program, "-b", "--factory-startup", "--python", SCRIPT)
            subprocess.run(
                (*command, "--", name, self._mode, str(len(jobs))),
                check=True,
                capture_output=True,
            )
            numbers = range(len(jobs))
            return (
                [np.load(folder / f"out_{k}.npy")[..., :3] for k in numbers],
                [float((folder / f"seconds_{k}.txt").read_text()) for k in numbers],
            )


def blender(mode: str):
    """Open a blur of the compositor.

    Parameters
    ----------
    mode : "bokeh" or "defocus"
    """

    def opened(problem: Problem) -> BlenderBlur:
        program = shutil.which("blender")
        if program is None:
            raise NotInstalled("blender")
        return BlenderBlur(program, mode, problem)

    return opened
