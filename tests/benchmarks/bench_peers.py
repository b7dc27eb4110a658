"""Alternatives to this filter: time and error of one frame by method.

    python -m tests.benchmarks.bench_peers [--quick] [--json] [--engines NAME ...]
        [--rows KIND ...]

All methods run one after the other and round after round (A B C, A B C), after a
warm-up.  In the first rounds, pupil and focus change with every frame (`frame_runs`),
so that PSFs or kernels are computed anew; the "frozen" rounds repeat the last state.
A method that takes seconds per frame takes part in one round of each kind.  Peers are
given linear light and diopters, which ours computes from its input within its time.

*Courtyard* at 1280x720 (320x180), a pupil of 5 mm that looks at 0.5 dpt, on the axis:
eyes of -6 dpt and of none, and an eye of -6 dpt without color and diffraction, whose
PSFs are even discs, for peers that have nothing else.  Errors are linear PSNR against
the dense reference of that state.

The same picture at 640x360 (320x180) on a wall at infinity, through a schematic eye
whose PSFs change over the visual field: ours and optiland.  Both compute PSFs from the
same surfaces, and each is compared with its own dense reference and the other's.

Single PSFs: those that ISETBio distributed, and ours of the same Zernike coefficients;
and that of the schematic eye on its axis, by rays, which DeepLens traces too.  Their
error is the share of the light that is elsewhere.

The gradient of the light in an image by the radius of the cornea, at one distance, of
ours, optiland and DeepLens (`peer_gradients`).  Its error is relative.

A row says what its method does otherwise, or more; one that is not installed has a row
too, and one that only its authors can measure has the figures that they printed.
`sh setup.sh peers` installs what can be installed.
"""

import argparse
import json
import sys
import time
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.engines import ENGINES, open_renderer
from tests.benchmarks.frame_runs import WARM_UPS, states_towards
from tests.benchmarks.harness import machine_info, report, write_report
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.peer_blender import blender
from tests.benchmarks.peer_deeplens import deeplens, traced_psf
from tests.benchmarks.peer_ffmpeg import FRAMES, varblur
from tests.benchmarks.peer_gradients import SETTING, gradient_methods
from tests.benchmarks.peer_isetbio import moved_light, our_psf, published_psfs
from tests.benchmarks.peer_layers import fft_layers, opencv_layers
from tests.benchmarks.peer_optiland import EYE, Optiland, flat_problem, optiland_peers
from tests.benchmarks.peer_problem import LAYER_COUNT, NotInstalled, Peer, Problem
from tests.benchmarks.peer_process import peer_versions
from tests.benchmarks.peer_published import PRINTED
from tests.benchmarks.peer_renderers import (
    FIELD_VARIANTS,
    VARIANTS,
    ours,
    sorted_gather,
)
from tests.numerical.scene_frames import scene_view

STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
EYES = {
    "-6 dpt": {"kind": "prescription", "sphere_dpt": -6.0, "higher_order": "none"},
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
}
DISC_CASE = "-6 dpt, disc"
DISC_SETTINGS = {"chromatic": False, "diffraction": False}
SIZE, FLAT_SIZE, QUICK_SIZE = (1280, 720), (640, 360), (320, 180)
REPEATS, QUICK_REPEATS = 5, 3

SLOW_MS = 5000.0
"""A method whose warm-up takes longer runs once in a new state and once in the same."""

EDGE_RATIO = 1 / 9
"""Of the height, left out along the edges of the flat scene, beyond which the methods
assume different light."""

ROWS = ("layers", "field", "psf", "gradient", "printed")
"""Kinds of rows, in the order in which they are measured."""

RAYS = 8192
"""Of a traced PSF: DeepLens's default."""

PACKAGES = ("opencv-python-headless", "imageio-ffmpeg")
PEER_PACKAGES = ("optiland", "deeplens-core", "torch")

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
        f"{LAYER_COUNT} layers, even discs by geometry, over; no PSF, color or field",
        opencv_layers("disc"),
    ),
    Peer(
        "OpenCV Gaussian",
        f"{LAYER_COUNT} layers, Gaussians, over; no PSF, color or field",
        opencv_layers("gaussian"),
    ),
    Peer(
        "ffmpeg varblur",
        "gathers boxes of each pixel's own radius, never under 2 px; no occlusion, "
        f"PSF, color or field; a process of {FRAMES} frames, its start in their time",
        varblur,
        frames_per_call=FRAMES,
    ),
    Peer(
        "Blender Bokeh",
        "gathers discs of each pixel's own radius in whole px; no occlusion, PSF, "
        "color or field; without Blender's start",
        blender("bokeh"),
    ),
    Peer(
        "Blender Defocus",
        "gathers discs, less of nearer into farther ones; no PSF, color or field; "
        "without Blender's start",
        blender("defocus"),
    ),
    Peer(
        "sorted gather",
        "our kernels for every pixel, sorted, in float64: no tiles, no merging",
        sorted_gather,
    ),
)

THIN_LENS = (
    "of a thin lens, over; no PSF, color or field. Does more: gradients, dual pixels"
)
THIN_LENSES = (
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
DISC_PEERS = (
    *(peer for peer in PEERS if peer.name != "sorted gather"),
    *THIN_LENSES,
)


@dataclass(frozen=True)
class PeerRow:
    """A method before one eye; times and error are None where it is not installed.

    Attributes
    ----------
    n : int
        Frames in new states; 0 if nothing was measured here.
    min_ms, median_ms : float or None
        Of frames in new states.
    frozen_min_ms, frozen_median_ms : float or None
        Of frames in the state of the frame before.
    error : float or None
        In the measure that ``error_name`` says, against ``reference``.
    differs : str
        What the method does otherwise, cannot do, or does beyond ours.
    missing : str or None
        What is not installed.
    prepare_s : float or None
        Time before the first frame: of ours, the PSFs of all states.
    other_error, other_reference : float or None, str or None
        The same against the reference of the other side.
    published : str or None
        Where time and error are printed, if they are not measured here.
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
    prepare_s: float | None = None
    other_error: float | None = None
    other_reference: str | None = None
    published: str | None = None


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
        start_s = time.perf_counter()
        try:
            frames[peer.name] = peer.open(problem)
        except NotInstalled as missing:
            line["missing"] = str(missing)
        line["prepare_s"] = time.perf_counter() - start_s
        found.append(line)
    count = WARM_UPS + repeats
    states = [
        problem.state(**s) for s in states_towards(problem.spec, **STATE, count=count)
    ]
    rounds = [(state, "times_ms") for state in states]
    rounds += [(states[-1], "frozen_ms")] * repeats
    for number, (state, kind) in enumerate(rounds):
        # the warm-up, the last new state and the first repeated one are for all
        for_all = number < WARM_UPS or number in (count - 1, count)
        for line in found:
            peer = line["peer"]
            is_slow = any(ms > SLOW_MS for ms in line["times_ms"][:WARM_UPS])
            if peer.name not in frames or (is_slow and not for_all):
                continue
            frame, start_s = frames[peer.name], time.perf_counter()
            line["color"] = frame(state)
            taken_ms = 1e3 * (time.perf_counter() - start_s)
            taken_ms = getattr(frame, "own_ms", taken_ms)
            line[kind].append(taken_ms / peer.frames_per_call)
    for line in found:
        del line["times_ms"][:WARM_UPS]
    for frame in frames.values():
        if hasattr(frame, "close"):
            frame.close()
    return found


def row_of(line: dict, **given) -> PeerRow:
    """Row of a measured line; ``given`` are the fields that it does not have."""
    is_there = line["missing"] is None
    times, frozen = line["times_ms"], line["frozen_ms"]
    return PeerRow(
        bench="peers",
        method=line["peer"].name,
        n=len(times),
        min_ms=min(times) if is_there else None,
        median_ms=float(np.median(times)) if is_there else None,
        frozen_min_ms=min(frozen) if is_there else None,
        frozen_median_ms=float(np.median(frozen)) if is_there else None,
        error_name="psnr_db",
        differs=line["peer"].differs,
        missing=line["missing"],
        prepare_s=line["prepare_s"] if is_there else None,
        **given,
    )


def peer_rows(problem: Problem, case: str, peers: list[Peer], repeats) -> list[PeerRow]:
    """Rows of one eye."""
    truth = dense_reference(problem.view, problem.state(**STATE), bins=True)
    size = f"{problem.view.width_px}x{problem.view.height_px}"
    return [
        row_of(
            line,
            case=case,
            setting=f"courtyard {size} on axis, 5 mm, 0.5 dpt",
            error=None if line["missing"] else channel_psnr_db(line["color"], truth),
            reference="dense, on the axis, bins of 0.005 dpt",
        )
        for line in measured(problem, peers, repeats)
    ]


OWN_REFERENCE = "dense, bins of 0.2 deg"
OPTILAND_REFERENCE = "dense, PSFs of optiland at points 20 px apart"


def flat_rows(view, engines: dict, repeats: int) -> list[PeerRow]:
    """Rows of a flat scene through PSFs that change over the visual field.

    Parameters
    ----------
    engines : dict
        Renderers by name.
    """
    problem = flat_problem(view)
    try:
        optiland = Optiland(problem)
    except NotInstalled:
        return _flat_rows(problem, engines, repeats, None)
    with closing(optiland):
        return _flat_rows(problem, engines, repeats, optiland)


def _flat_rows(
    problem: Problem, engines: dict, repeats: int, optiland: Optiland | None
) -> list[PeerRow]:
    view, state = problem.view, problem.state(**STATE)
    own = dense_reference(view, state, bins=True)
    other = None if optiland is None else optiland.reference(state)
    edge_px = round(EDGE_RATIO * view.height_px)
    inner = (slice(edge_px, -edge_px),) * 2

    def error(line: dict, truth) -> float | None:
        if line["missing"] is not None or truth is None:
            return None
        return channel_psnr_db(line["color"][inner], truth[inner])

    rows = []
    ours_first = our_peers(engines, FIELD_VARIANTS)
    peers = [*ours_first, *optiland_peers(optiland)]
    for line in measured(problem, peers, repeats):
        sides = [(own, OWN_REFERENCE), (other, OPTILAND_REFERENCE)]
        if line["peer"] not in ours_first:
            sides.reverse()
        rows.append(
            row_of(
                line,
                case=EYE["name"],
                setting=f"courtyard on a wall {view.width_px}x{view.height_px}, "
                "30 deg, 5 mm",
                error=error(line, sides[0][0]),
                reference=sides[0][1],
                other_error=error(line, sides[1][0]),
                other_reference=sides[1][1],
            )
        )
    return rows


def psf_row(*, taken_ms: float | None, error: float | None, **given) -> PeerRow:
    """Row of one PSF, whose error is the share of the light that is elsewhere."""
    return PeerRow(
        bench="peers",
        n=0 if taken_ms is None else 1,
        min_ms=taken_ms,
        median_ms=taken_ms,
        frozen_min_ms=None,
        frozen_median_ms=None,
        error_name="moved_light_ratio",
        error=error,
        **given,
    )


def isetbio_rows() -> list[PeerRow]:
    """Rows of ISETBio's PSFs and ours."""
    rows = []
    for published in published_psfs():
        psf, taken_ms = our_psf(published)
        rows.append(
            psf_row(
                method="ours, PSF",
                case=published.label,
                setting=f"{published.psf.shape[0]} samples of "
                f"{published.sample_arcmin:.3f} arcmin, 550 nm",
                taken_ms=taken_ms,
                error=moved_light(psf, published.psf),
                reference="PSF of ISETBio, from a pupil raster of 0.081 mm",
                differs="ISETBio does more: full spectra, cones and retinal circuits",
                missing=None,
            )
        )
    return rows


def traced_rows(view) -> list[PeerRow]:
    """Rows of a PSF that DeepLens traces, and ours of the same eye."""
    problem = flat_problem(view, diffraction=False)
    state, axis = problem.state(**STATE), np.zeros(1)
    missing = None
    times_ms = {"ours": None, "DeepLens": None}
    psfs = {}
    for _ in range(2):  # the first warms up
        start_s = time.perf_counter()
        kernel = state.exact_psfs(axis, axis, axis)[1].kernel
        times_ms["ours"] = 1e3 * (time.perf_counter() - start_s)
    psfs["ours"] = kernel / kernel.sum()
    try:
        found, times_ms["DeepLens"] = traced_psf(
            problem, state, side_px=kernel.shape[0], rays=RAYS
        )
        psfs["DeepLens"] = found / found.sum()
    except NotInstalled as error:
        missing = str(error)
    moved = None if missing else moved_light(*psfs.values())
    pitch_mrad, _ = problem.spec.pixel_pitch_mrad
    shared = {
        "case": f"{EYE['name']}, axis",
        "setting": f"{kernel.shape[0]} px of {pitch_mrad:.2f} mrad, "
        "5 mm, no diffraction",
        "error": moved,
    }
    return [
        psf_row(
            method="ours, PSF",
            taken_ms=times_ms["ours"],
            reference="DeepLens",
            differs="three colors, and the wavefront that they come from",
            missing=None,
            **shared,
        ),
        psf_row(
            method="DeepLens GeoLens, PSF",
            taken_ms=times_ms["DeepLens"],
            reference="ours",
            differs=f"one color, {RAYS} rays, flat sensor, stop at a surface. Does "
            "more: gradients for lens design, distortion, coherent light",
            missing=missing,
            **shared,
        ),
    ]


def gradient_rows() -> list[PeerRow]:
    """Rows of the gradient of defocus, whose errors are relative."""
    rows = []
    for peer in gradient_methods():
        found, missing = None, None
        try:
            found = peer.gradient()
        except NotInstalled as error:
            missing = str(error)
        row = psf_row(
            method=peer.name,
            case="schematic eye, cornea",
            setting=SETTING,
            taken_ms=None if found is None else found.taken_ms,
            error=None if found is None else found.error,
            reference=peer.reference,
            differs=peer.differs,
            missing=missing,
        )
        rows.append(replace(row, error_name="relative"))
    return rows


def printed_rows() -> list[PeerRow]:
    """Rows of methods that only their authors could measure."""
    return [
        PeerRow(
            bench="peers",
            method=peer.name,
            case="as printed",
            setting="not measured here",
            n=0,
            min_ms=None,
            median_ms=peer.at_most_ms,
            frozen_min_ms=None,
            frozen_median_ms=None,
            error_name="psnr_db",
            error=peer.psnr_db[0],
            reference="the authors' own",
            differs=peer.differs,
            missing=None,
            published=peer.source,
        )
        for peer in PRINTED
    ]


def installed_versions() -> dict[str, str | None]:
    """Versions of what `setup.sh peers` installs; None of what is missing."""
    found: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found | peer_versions(PEER_PACKAGES)


HEADER = (
    f"{'eye':<34}{'method':<28}{'min':>9}{'median':>9}{'frozen: min':>13}{'median':>9}"
    f"{'error':>8}{'other':>7}  what differs"
)


def line_of(row: PeerRow) -> str:
    """One line of the table; errors are dB, shares of light, or relative."""
    start = f"{row.case:<34}{row.method:<28}"
    if row.missing is not None:
        return f"{start}not installed: {row.missing}"
    times = [row.min_ms, row.median_ms, row.frozen_min_ms, row.frozen_median_ms]
    cells = [
        f"{'' if ms is None else f'{ms:.1f}':>{width}}"
        for ms, width in zip(times, (9, 9, 13, 9), strict=True)
    ]
    digits = {"psnr_db": 1, "moved_light_ratio": 3}.get(row.error_name, 5)
    cells += [
        f"{'' if error is None else f'{error:.{digits}f}':>{width}}"
        for error, width in ((row.error, 8), (row.other_error, 7))
    ]
    source = "" if row.published is None else f" ({row.published})"
    return f"{start}{''.join(cells)}  {row.differs}{source}"


def main() -> None:
    """Run, print, and write tests/benchmarks/results/peers.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180, fewer rounds")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    arguments = parser.parse_args()
    width_px, height_px = QUICK_SIZE if arguments.quick else SIZE
    repeats = QUICK_REPEATS if arguments.quick else REPEATS
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    engines = {name: open_renderer(name) for name in arguments.engines}
    flat_size = QUICK_SIZE if arguments.quick else FLAT_SIZE
    flat_view = scene_view("courtyard", width_px=flat_size[0], height_px=flat_size[1])
    ours_first = our_peers(engines)
    cases = [
        (case, Problem(view, profile), [*ours_first, *PEERS])
        for case, profile in EYES.items()
    ]
    disc = Problem(view, EYES["-6 dpt"], DISC_SETTINGS)
    cases.append((DISC_CASE, disc, [*ours_first, *DISC_PEERS]))
    layers = [partial(peer_rows, p, case, peers, repeats) for case, p, peers in cases]
    parts = {
        "layers": layers,
        "field": [partial(flat_rows, flat_view, engines, repeats)],
        "psf": [partial(traced_rows, view), isetbio_rows],
        "gradient": [gradient_rows],
        "printed": [printed_rows],
    }
    rows = []
    for part in (part for name in arguments.rows for part in parts[name]):
        found = part()
        rows += found
        print(*map(line_of, found), sep="\n", file=sys.stderr, flush=True)
    names = {name: renderer.name for name, renderer in engines.items()}
    machine = {**machine_info(), "renderers": names, **installed_versions()}
    content = report(rows, machine=machine)
    if arguments.json:
        print(json.dumps(content))
        return
    print(HEADER, *map(line_of, rows), sep="\n")
    if not arguments.quick and list(arguments.rows) == list(ROWS):
        write_report("peers", content)


if __name__ == "__main__":
    main()
