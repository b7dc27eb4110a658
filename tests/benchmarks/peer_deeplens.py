"""The peer DeepLens: thin-lens defocus with the focus and pupil of the eye."""

from pathlib import Path

from tests.benchmarks.peer_problem import Peer, Problem
from tests.benchmarks.peer_process import PeerFrames
from tests.benchmarks.view_sources import EyeState

SCRIPT = Path(__file__).with_name("peer_deeplens_script.py")


def deeplens(mode: str, layers: int):
    """Open a thin lens with the focus of green light.

    Parameters
    ----------
    mode : "render_rgbd" or "pillbox"
    layers : int
    """

    def opened(problem: Problem) -> PeerFrames:
        camera = problem.spec.camera
        left, right, _, _ = camera.tangents

        def arguments(state: EyeState) -> dict:
            return {
                "mode": mode,
                "layers": layers,
                "focus_dpt": -problem.defocus_dpt(state),
                "pupil_mm": state.pupil_diameter_mm,
                "pitch": (right - left) / camera.width_px,
                "size_px": [camera.width_px, camera.height_px],
            }

        arrays = {"color.npy": problem.color, "dpt.npy": problem.distance_dpt}
        return PeerFrames(SCRIPT, "deeplens-core", arrays, {}, arguments)

    return opened


THIN_LENS = (
    "of a thin lens, over; no PSF, color or field. Does more: gradients, dual pixels"
)
PEERS = (
    Peer(
        "DeepLens render_rgbd",
        f"16 layers, Gaussians within the circle of confusion {THIN_LENS}",
        deeplens("render_rgbd", 16),
    ),
    Peer(
        "DeepLens discs",
        "8 layers, which gave the smallest error, discs without antialiasing, divided "
        f"by their coverage; {THIN_LENS}",
        deeplens("pillbox", 8),
    ),
)
