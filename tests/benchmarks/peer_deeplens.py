"""The peer DeepLens: thin-lens defocus with the focus and pupil of the eye."""

from pathlib import Path

from numpy.typing import NDArray

from tests.benchmarks.peer_problem import Peer, Problem
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


THIN_LENS = (
    "of a thin lens, over; no PSF, color or field. Does more: gradients, dual pixels"
)
PEERS = (
    Peer(
        "DeepLens render_rgbd",
        f"16 layers, Gaussians within the circle of confusion {THIN_LENS}",
        lambda problem: DefocusFrames(problem, "render_rgbd", 16),
    ),
    Peer(
        "DeepLens discs",
        "8 layers, which gave the smallest error, discs without antialiasing, divided "
        f"by their coverage; {THIN_LENS}",
        lambda problem: DefocusFrames(problem, "pillbox", 8),
    ),
)
