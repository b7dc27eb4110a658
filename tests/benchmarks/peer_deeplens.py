"""The peer DeepLens: thin-lens defocus with the focus and pupil of the eye."""

from pathlib import Path

from numpy.typing import NDArray

from estimator.profiles.parse import parse_profile
from tests.benchmarks.peer_optiland import eye_request
from tests.benchmarks.peer_problem import Problem
from tests.benchmarks.peer_process import PeerProcess, require
from tests.benchmarks.view_sources import EyeState

SCRIPT = Path(__file__).with_name("peer_deeplens_script.py")


class DefocusFrames:
    """Frames of a problem's picture.

    Attributes
    ----------
    own_ms : float
        Of the last frame, without the exchange of files.
    """

    def __init__(self, problem: Problem, mode: str, layers: int):
        require("deeplens-core")
        self._problem = problem
        self._arguments = {"mode": mode, "layers": layers}
        self._process = PeerProcess(SCRIPT)
        self._process.write("color.npy", problem.color)
        self._process.write("dpt.npy", problem.distance_dpt)
        self._process.ask("open")
        self.own_ms = 0.0

    def __call__(self, state: EyeState) -> NDArray:
        """Filter the picture with the focus of green light."""
        camera = self._problem.spec.camera
        left, right, _, _ = camera.tangents
        answer = self._process.ask(
            "frame",
            **self._arguments,
            focus_dpt=-self._problem.defocus_dpt(state),
            pupil_mm=state.pupil_diameter_mm,
            pitch=(right - left) / camera.width_px,
            size_px=[camera.width_px, camera.height_px],
        )
        self.own_ms = 1e3 * answer["seconds"]
        return self._process.read("out.npy")

    def close(self) -> None:
        """End the process."""
        self._process.close()


def traced_psf(problem: Problem, state: EyeState, *, side_px: int, rays: int):
    """Trace the green PSF on the axis of a centered eye.

    Returns
    -------
    psf : (side, side)
    taken_ms : float
    """
    require("deeplens-core")
    camera = problem.spec.camera
    left, right, _, _ = camera.tangents
    eye = parse_profile(problem.profile).surfaces.relaxed
    wavelength_nm = float(problem.spec.channel_wavelengths_nm[1])
    process = PeerProcess(SCRIPT)
    try:
        answer = process.ask(
            "psf",
            eye=eye_request(eye, wavelength_nm),
            wavelength_nm=wavelength_nm,
            pupil_mm=state.pupil_diameter_mm,
            pitch=(right - left) / camera.width_px,
            side_px=side_px,
            rays=rays,
        )
        return process.read("out.npy"), 1e3 * answer["seconds"]
    finally:
        process.close()


def deeplens(mode: str, layers: int):
    """Open a thin lens.

    Parameters
    ----------
    mode : "render_rgbd" or "pillbox"
    layers : int
    """
    return lambda problem: DefocusFrames(problem, mode, layers)
