"""ffmpeg's `varblur` among the peers: a box blur whose radius is an image."""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.peer_problem import NotInstalled, Peer, Problem
from tests.benchmarks.view_sources import EyeState

FRAMES = 8
"""Frames of one process: its start is shared among them, as in a stream."""

FORMAT = "gbrpf32le"
PLANES = (1, 2, 0)
"""Green, blue, red."""

BOX_OF_RADIUS = 3.0**0.5
"""Side of the box as wide as a disc, by its variance."""

MAX_RADIUS = 64
"""Of the filter's own scale, which `_box_sides` measures."""

PROBE_PX = 600


def varblur(problem: Problem):
    """Open the filter; its boxes are as wide as the discs of green light."""
    program = _program()
    slope, least_px = _box_sides(program)

    def frame(state: EyeState) -> NDArray:
        radius_px = problem.disc_radius_px(state, problem.distance_dpt)
        wanted = (BOX_OF_RADIUS * radius_px - least_px) / slope
        share = np.clip(wanted / MAX_RADIUS, 0.0, 1.0)
        return _filtered(program, problem.color, share, frames=FRAMES)

    return frame


def _program() -> str:
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise NotInstalled("imageio-ffmpeg") from error
    answer = subprocess.run(
        (program, "-hide_banner", "-h", "filter=varblur"),
        capture_output=True,
        text=True,
        check=False,
    )
    if "max_r" not in answer.stdout:
        raise NotInstalled(f"the filter varblur in {Path(program).name}")
    return program


def _box_sides(program: str) -> tuple[float, float]:
    """Side of the box, px, as slope and least of the radius asked for.

    Builds differ: where the manual has 2 r + 1, ffmpeg 9.0 draws 8 r + 2.
    """
    point = np.zeros((PROBE_PX, PROBE_PX, 3), np.float32)
    point[PROBE_PX // 2, PROBE_PX // 2] = 1.0
    radii, sides = (4, 16), []
    for radius in radii:
        share = np.full(point.shape[:2], radius / MAX_RADIUS)
        seen = _filtered(program, point, share)
        sides.append(float(seen[..., 1].max()) ** -0.5)
    slope = (sides[1] - sides[0]) / (radii[1] - radii[0])
    return slope, sides[0] - slope * radii[0]


def _filtered(program: str, color: NDArray, share: NDArray, frames: int = 1) -> NDArray:
    """Run the program on one picture so many times; the last that it gives back."""
    height, width = share.shape
    planes = np.moveaxis(color, -1, 0)[list(PLANES)].astype("<f4")
    radii = np.broadcast_to(share.astype("<f4"), planes.shape)
    with tempfile.TemporaryDirectory() as folder:
        inputs = []
        for name, images in (("color", planes), ("radius", radii)):
            path = Path(folder) / name
            path.write_bytes(np.ascontiguousarray(images).tobytes())
            inputs += ["-stream_loop", str(frames - 1), "-f", "rawvideo"]
            inputs += ["-pix_fmt", FORMAT, "-s", f"{width}x{height}", "-i", str(path)]
        answer = subprocess.run(
            (
                *(program, "-v", "error", *inputs),
                *("-lavfi", f"[0][1]varblur=min_r=0:max_r={MAX_RADIUS}"),
                *("-f", "rawvideo", "-pix_fmt", FORMAT, "-"),
            ),
            capture_output=True,
            check=True,
        )
    found = np.frombuffer(answer.stdout, "<f4").reshape(frames, 3, height, width)[-1]
    return np.moveaxis(found[np.argsort(PLANES)], 0, -1)


PEERS = (
    Peer(
        "ffmpeg varblur",
        "gathers boxes of each pixel's own radius, never under 2 px; no occlusion, "
        f"PSF, color or field; a process of {FRAMES} frames, its start in their time",
        varblur,
        frames_per_call=FRAMES,
    ),
)
