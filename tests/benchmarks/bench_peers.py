"""Alternatives to this filter: time and error of one frame by method.

All methods run one after the other and round after round (A B C, A B C), after a
warm-up.  In the first rounds, pupil and focus change with every frame (`frame_runs`),
so that PSFs or kernels are computed anew; the "frozen" rounds repeat the last state.
A method that takes seconds per frame takes part in one round of each kind.  Peers are
given linear light and diopters, which ours computes from its input within its time.

``layers``: *Courtyard* at 1280x720, a pupil of 5 mm that looks at 0.5 dpt, on the axis:
eyes of -6 dpt and of none, and an eye of -6 dpt without color and diffraction, whose
PSFs are even discs, for peers that have nothing else.  Errors are linear PSNR against
the dense reference of that state.

``field``: the same picture at 640x360 on a wall at infinity, through a schematic eye
whose PSFs change over the visual field: ours and optiland.  Both compute PSFs from the
same surfaces, and each is compared with its own dense reference and the other's.

``psf``: PSFs that ISETBio distributed, and ours of the same Zernike coefficients.  The
error is the share of the light that is elsewhere.

``gradient``: the gradient of the light in an image by the radius of the cornea, at one
distance, of ours, optiland and DeepLens (`peer_gradients`).  Its error is relative.

``printed``: figures that the authors of a method without public code printed.

``methods`` says what a method does differently, or beyond ours, and ``missing`` which
are not installed: `sh setup.sh peers` installs what can be installed.
"""

import time
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from filter_service.rendering.native import NativeRenderer
from tests.benchmarks import peer_deeplens, peer_ffmpeg, peer_layers, peer_optiland
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.frame_runs import WARM_UPS, states_towards
from tests.benchmarks.harness import Row, Run, memory_mb
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.peer_gradients import SETTING, gradient_methods
from tests.benchmarks.peer_problem import (
    FIELD_VARIANTS,
    VARIANTS,
    NotInstalled,
    Peer,
    Problem,
    ours,
)
from tests.benchmarks.peer_process import peer_versions
from tests.isetbio_psfs import moved_light, our_psf, published_psfs
from tests.numerical.scene_frames import scene_view

MINUTES = 8
STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
EYES = {
    "-6 dpt": {"kind": "prescription", "sphere_dpt": -6.0, "higher_order": "none"},
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
}
DISC_CASE = "-6 dpt, disc"
DISC_SETTINGS = {"chromatic": False, "diffraction": False}
SIZE, FLAT_SIZE, QUICK_SIZE = (1280, 720), (640, 360), (320, 180)
REPEATS = 3

SLOW_MS = 5000.0
"""A method whose warm-up takes longer runs once in a new state and once in the same."""

EDGE_RATIO = 1 / 9
"""Of the height, left out along the edges of the flat scene, beyond which the methods
assume different light."""

PACKAGES = ("opencv-python-headless", "imageio-ffmpeg")
PEER_PACKAGES = ("optiland", "deeplens-core", "torch")
PEERS = (*peer_layers.PEERS, *peer_ffmpeg.PEERS)
DISC_PEERS = (*PEERS, *peer_deeplens.PEERS)

PRINTED = (
    {
        "method": "light-gathering trees",
        "times_ms": (6.0,),
        "error": 32.4,
        "differs": "samples of the pupil looked up in layered images; low-order "
        "aberrations and partial occlusion, no diffraction, color or field",
        "published": "Lima, Medeiros, Marques & Oliveira, The Visual Computer 37(9), "
        "2021, abstract: over 300 samples per pixel in under 6 ms per frame, PSNR 32.4 "
        "to 43.0, SSIM 0.94 to 0.99; it names neither resolution nor hardware",
    },
)


@dataclass(frozen=True)
class PeerRow(Row):
    """A method in one case.

    Attributes
    ----------
    n : int
        Frames in new states, whose times are those of a row; 0 if nothing was measured
        here.
    min_ms : float
    frozen_min_ms, frozen_median_ms : float or None
        Of frames in the state of the frame before.
    differs : str
        What the method does otherwise, cannot do, or does beyond ours.
    missing : str or None
        What is not installed; times and error are then NaN.
    prepare_s : float or None
        Time before the first frame: of ours, the PSFs of all states.
    other_error, other_reference : float or None, str or None
        The same error against the reference of the other side.
    published : str or None
        Where time and error are printed, if they are not measured here.
    """

    min_ms: float
    frozen_min_ms: float | None
    frozen_median_ms: float | None
    differs: str
    missing: str | None = None
    prepare_s: float | None = None
    other_error: float | None = None
    other_reference: str | None = None
    published: str | None = None


def peer_row(
    *, method, case, setting, times_ms, error, reference, frozen_ms=(), **more
) -> PeerRow:
    """Make a row of times in ms; ``error`` is None if there is none."""
    times = np.array(times_ms if len(times_ms) else [np.nan])
    return PeerRow(
        *("peers", method, case, setting, len(times_ms)),
        *(float(np.median(times)), float(np.percentile(times, 95)), memory_mb()),
        more.pop("error_name", "psnr_db"),
        *(float("nan") if error is None else error, reference, float(times.min())),
        frozen_min_ms=min(frozen_ms) if len(frozen_ms) else None,
        frozen_median_ms=float(np.median(frozen_ms)) if len(frozen_ms) else None,
        **more,
    )


def our_peers(variants=VARIANTS) -> list[Peer]:
    """Return ours with each variant."""
    renderer = NativeRenderer()
    return [
        Peer(
            f"ours native {variant.label}",
            "coverage by depth, merged fragments unless it says otherwise; any pupil, "
            "focus and, prepared for it, field",
            ours(renderer, variant),
        )
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
    return peer_row(
        method=line["peer"].name,
        differs=line["peer"].differs,
        prepare_s=None if line["missing"] else line["prepare_s"],
        **{key: line[key] for key in ("times_ms", "frozen_ms", "missing")},
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


def flat_rows(view, repeats: int) -> Iterator[PeerRow]:
    """Yield rows of a flat scene through PSFs that change over the visual field."""
    problem = peer_optiland.flat_problem(view)
    view, state, theirs = problem.view, problem.state(**STATE), None
    with suppress(NotInstalled):
        theirs = peer_optiland.reference(problem, state)
    edge_px = round(EDGE_RATIO * view.height_px)
    inner = (slice(edge_px, -edge_px),) * 2
    sides = [
        ("dense, bins of 0.2 deg", dense_reference(view, state, bins=True)),
        ("dense, PSFs of optiland at points 20 px apart", theirs),
    ]
    ours_first = our_peers(FIELD_VARIANTS)
    peers = [*ours_first, *peer_optiland.PEERS]
    for line in measured(problem, peers, repeats):
        (own, other) = sides if line["peer"] in ours_first else sides[::-1]
        own_db, other_db = (
            None
            if line["missing"] or truth is None
            else channel_psnr_db(line["color"][inner], truth[inner])
            for _, truth in (own, other)
        )
        yield row_of(
            line,
            case=peer_optiland.EYE["name"],
            setting=f"courtyard on a wall {view.width_px}x{view.height_px}, 30 deg, "
            "5 mm",
            error=own_db,
            reference=own[0],
            other_error=other_db,
            other_reference=other[0],
        )


def isetbio_rows() -> Iterator[PeerRow]:
    """Yield rows of ISETBio's PSFs and ours."""
    for published in published_psfs():
        psf, taken_ms = our_psf(published)
        yield peer_row(
            method="ours, PSF",
            case=published.label,
            setting=f"{published.psf.shape[0]} samples of "
            f"{published.sample_arcmin:.3f} arcmin, 550 nm",
            times_ms=[taken_ms],
            error_name="moved_light_ratio",
            error=moved_light(psf, published.psf),
            reference="PSF of ISETBio, from a pupil raster of 0.081 mm",
            differs="ISETBio does more: full spectra, cones and retinal circuits",
        )


def gradient_rows() -> Iterator[PeerRow]:
    """Yield rows of the gradient of defocus, whose errors are relative."""
    for name, gradient, reference, differs in gradient_methods():
        found, missing = None, None
        try:
            found = gradient()
        except NotInstalled as error:
            missing = str(error)
        yield peer_row(
            method=name,
            case="schematic eye, cornea",
            setting=SETTING,
            times_ms=[] if found is None else [found.taken_ms],
            error_name="relative",
            error=found and found.error,
            reference=reference,
            differs=differs,
            missing=missing,
        )


def printed_rows() -> list[PeerRow]:
    """Rows of methods that only their authors could measure."""
    return [
        replace(
            peer_row(
                case="as printed",
                setting="not measured here",
                reference="the authors' own",
                **printed,
            ),
            n=0,
        )
        for printed in PRINTED
    ]


def layer_rows(*, is_quick: bool) -> Iterator[PeerRow]:
    """Yield rows of a picture with depth, on the axis."""
    width_px, height_px = QUICK_SIZE if is_quick else SIZE
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    disc = Problem(view, EYES["-6 dpt"], DISC_SETTINGS)
    cases = [(case, Problem(view, profile), PEERS) for case, profile in EYES.items()]
    for case, problem, peers in (*cases, (DISC_CASE, disc, DISC_PEERS)):
        yield from peer_rows(problem, case, [*our_peers(), *peers], REPEATS)


def field_rows(*, is_quick: bool) -> Iterator[PeerRow]:
    """Return rows of a flat picture over the visual field."""
    width_px, height_px = QUICK_SIZE if is_quick else FLAT_SIZE
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    return flat_rows(view, REPEATS)


KINDS = {
    "layers": layer_rows,
    "field": field_rows,
    "psf": lambda *, is_quick: isetbio_rows(),
    "gradient": lambda *, is_quick: gradient_rows(),
    "printed": lambda *, is_quick: printed_rows(),
}
"""Kinds of rows, in the order in which they are measured."""


def installed_versions() -> dict[str, str | None]:
    """Versions of what `setup.sh peers` installs; None of what is missing."""
    found: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found | peer_versions(PEER_PACKAGES)


def options(parser: ArgumentParser) -> None:
    """Add the choice of rows."""
    parser.add_argument("--rows", nargs="+", choices=KINDS, default=list(KINDS))


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, methods, versions of packages, and what is missing."""
    rows = [
        row for kind in run.options.rows for row in KINDS[kind](is_quick=run.is_quick)
    ]
    differs = {row.method: row.differs for row in rows}
    missing = {row.method: row.missing for row in rows if row.missing}
    return [row for row in rows if not row.missing], {
        "methods": [{"method": name, "differs": differs[name]} for name in differs],
        "packages": [installed_versions()],
        "missing": [
            {"method": name, "not_installed": missing[name]} for name in missing
        ],
    }
