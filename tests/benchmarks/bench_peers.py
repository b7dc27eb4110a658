"""Alternatives to this filter: time and error of one frame by method.

    python -m tests.benchmarks.bench_peers [--quick] [--json] [--engines NAME ...]

*Courtyard* at 1280x720 (320x180), a pupil of 5 mm that looks at 0.5 dpt, all on the
axis: eyes of -6 dpt and of none.  Errors are linear PSNR against the dense reference of
that state.  All methods run in this process or from it, one after the other and round
after round (A B C, A B C), after a warm-up.  In the first rounds pupil and focus change
with every frame (`frame_runs`), so that PSFs or kernels are made anew; the "frozen"
rounds repeat the last state.  Peers are given linear light and dioptres, which ours
makes from its input within its time.

A row says what its method does otherwise; one that is not installed has a row too.
"""

import argparse
import json
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.engines import ENGINES, open_renderer
from tests.benchmarks.frame_runs import WARM_UPS, states_towards
from tests.benchmarks.harness import machine_info, report, write_report
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.peer_blender import blender
from tests.benchmarks.peer_ffmpeg import FRAMES, varblur
from tests.benchmarks.peer_layers import fft_layers, opencv_layers
from tests.benchmarks.peer_problem import LAYER_COUNT, NotInstalled, Peer, Problem
from tests.benchmarks.peer_renderers import VARIANTS, ours, sorted_gather
from tests.numerical.scene_frames import scene_view

STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
EYES = {
    "-6 dpt": {"kind": "prescription", "sphere_dpt": -6.0, "higher_order": "none"},
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
}
SIZE, QUICK_SIZE = (1280, 720), (320, 180)
REPEATS, QUICK_REPEATS = 5, 3

PACKAGES = ("opencv-python-headless", "imageio-ffmpeg")

ON_AXIS_ONLY = "no field"
PEERS = (
    Peer(
        "FFT linear",
        f"{LAYER_COUNT} layers of exact PSFs with linear weights between, clamped "
        f"coverage near to far; {ON_AXIS_ONLY}",
        fft_layers(linear=True),
    ),
    Peer(
        "FFT over",
        f"{LAYER_COUNT} layers of exact PSFs, far to near over each other: seams where "
        f"layers meet; {ON_AXIS_ONLY}",
        fft_layers(linear=False),
    ),
    Peer(
        "OpenCV disc",
        f"{LAYER_COUNT} layers, even discs by geometry, over; no PSF, colour or field",
        opencv_layers("disc"),
    ),
    Peer(
        "OpenCV Gaussian",
        f"{LAYER_COUNT} layers, Gaussians, over; no PSF, colour or field",
        opencv_layers("gaussian"),
    ),
    Peer(
        "ffmpeg varblur",
        "gathers boxes of each pixel's own radius, never under 2 px; no occlusion, "
        f"PSF, colour or field; a process of {FRAMES} frames, its start in their time",
        varblur,
        frames_per_call=FRAMES,
    ),
    Peer(
        "Blender Bokeh",
        "gathers discs of each pixel's own radius in whole px; no occlusion, PSF, "
        "colour or field; without Blender's start",
        blender("bokeh"),
    ),
    Peer(
        "Blender Defocus",
        "gathers discs, less of nearer into farther ones; no PSF, colour or field; "
        "without Blender's start",
        blender("defocus"),
    ),
    Peer(
        "sorted gather",
        "our kernels for every pixel, sorted, in float64: no tiles, no merging",
        sorted_gather,
    ),
)


@dataclass(frozen=True)
class PeerRow:
    """A method before one eye; times and error are None where it is not installed.

    Attributes
    ----------
    min_ms, median_ms : float or None
        Of frames in new states.
    frozen_min_ms, frozen_median_ms : float or None
        Of frames in the state of the frame before.
    error : float or None
        Linear PSNR against the dense reference.
    differs : str
        What the method does otherwise, and cannot do.
    missing : str or None
        What is not installed.
    """

    bench: str
    method: str
    case: str
    setting: str
    n: int
    min_ms: float | None
    median_ms: float | None
    frozen_min_ms: float | None
    frozen_median_ms: float | None
    error_name: str
    error: float | None
    reference: str
    differs: str
    missing: str | None


def our_peers(engines, variants=VARIANTS) -> list[Peer]:
    """Return ours, each engine with each variant.

    Parameters
    ----------
    engines : dict
        Renderers by name.
    """
    return [
        Peer(
            f"ours {name} {variant.label}".strip(),
            "coverage by depth, merged fragments unless it says otherwise; any pupil, "
            "focus and, prepared for it, field",
            ours(renderer, variant),
        )
        for name, renderer in engines.items()
        for variant in variants
    ]


def measured(problem: Problem, peers: list[Peer], repeats: int) -> list[dict]:
    """Run all peers in turn; name, times, picture or what is missing, by peer."""
    found, frames = [], {}
    for peer in peers:
        line = {"peer": peer, "times_ms": [], "frozen_ms": [], "missing": None}
        try:
            frames[peer.name] = peer.open(problem)
        except NotInstalled as missing:
            line["missing"] = str(missing)
        found.append(line)
    count = WARM_UPS + repeats
    states = [
        problem.state(**s) for s in states_towards(problem.spec, **STATE, count=count)
    ]
    rounds = [(state, "times_ms") for state in states]
    rounds += [(states[-1], "frozen_ms")] * repeats
    for state, kind in rounds:
        for line in found:
            peer = line["peer"]
            if peer.name in frames:
                frame, start_s = frames[peer.name], time.perf_counter()
                line["color"] = frame(state)
                taken_ms = 1e3 * (time.perf_counter() - start_s)
                taken_ms = getattr(frame, "own_ms", taken_ms)
                line[kind].append(taken_ms / peer.frames_per_call)
    for line in found:
        del line["times_ms"][:WARM_UPS]
    return found


def peer_rows(problem: Problem, case: str, peers: list[Peer], repeats) -> list[PeerRow]:
    """Rows of one eye."""
    truth = dense_reference(problem.view, problem.state(**STATE), bins=True)
    size = f"{problem.view.width_px}x{problem.view.height_px}"
    rows = []
    for line in measured(problem, peers, repeats):
        is_there = line["missing"] is None
        times = [line["times_ms"], line["frozen_ms"]]
        rows.append(
            PeerRow(
                bench="peers",
                method=line["peer"].name,
                case=case,
                setting=f"courtyard {size} on axis, 5 mm, 0.5 dpt",
                n=len(line["times_ms"]),
                min_ms=min(times[0]) if is_there else None,
                median_ms=float(np.median(times[0])) if is_there else None,
                frozen_min_ms=min(times[1]) if is_there else None,
                frozen_median_ms=float(np.median(times[1])) if is_there else None,
                error_name="psnr_db",
                error=channel_psnr_db(line["color"], truth) if is_there else None,
                reference="dense, on the axis, bins of 0.005 dpt",
                differs=line["peer"].differs,
                missing=line["missing"],
            )
        )
    return rows


def installed_versions() -> dict[str, str | None]:
    """Versions of the extra `peers`; None of what is missing."""
    found: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


HEADER = (
    f"{'eye':<12}{'method':<20}{'min':>8}{'median':>8}{'frozen: min':>13}{'median':>8}"
    f"{'dB':>7}  what differs"
)


def line_of(row: PeerRow) -> str:
    """One line of the table."""
    start = f"{row.case:<12}{row.method:<20}"
    if row.missing is not None:
        return f"{start}not installed: {row.missing}"
    return (
        f"{start}{row.min_ms:8.1f}{row.median_ms:8.1f}{row.frozen_min_ms:13.1f}"
        f"{row.frozen_median_ms:8.1f}{row.error:7.1f}  {row.differs}"
    )


def main() -> None:
    """Run, print, and write tests/benchmarks/results/peers.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180, fewer rounds")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    arguments = parser.parse_args()
    width_px, height_px = QUICK_SIZE if arguments.quick else SIZE
    repeats = QUICK_REPEATS if arguments.quick else REPEATS
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    engines = {name: open_renderer(name) for name in arguments.engines}
    peers = [*our_peers(engines), *PEERS]
    rows = []
    for case, profile in EYES.items():
        rows += peer_rows(Problem(view, profile), case, peers, repeats)
        print(*map(line_of, rows[-len(peers) :]), sep="\n", file=sys.stderr)
    names = {name: renderer.name for name, renderer in engines.items()}
    machine = {**machine_info(), "renderers": names, **installed_versions()}
    content = report(rows, machine=machine)
    if arguments.json:
        print(json.dumps(content))
        return
    print(HEADER, *map(line_of, rows), sep="\n")
    if not arguments.quick:
        write_report("peers", content)


if __name__ == "__main__":
    main()
