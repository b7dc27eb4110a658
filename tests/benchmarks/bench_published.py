"""The published pipeline as one setting, beside the default, through six eyes.

`EyeFilter` with ``pipeline="published"``, by default, and with the published grid and
accumulation alone, in the paper's state, 5 mm and 0.5 dpt, of a part of *Primitives*.
The error is that of linear light against the exact PSF of every pixel
(`dense_reference`) of the traced eye, whose periphery follows from its surfaces as in
the paper.  Times are of the processor, all threads together: until eye and PSFs of a
first frame are ready (``prepare_ms``), and of a frame after that.

If it is missing, a whole run writes tests/data/published_pipeline.npz, with which
the tests compare those of the service.
"""

import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.networks.inference import load_network
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.rendering.media_effects import linear_from_srgb, srgb_from_linear
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import PERIPHERY, EyeBench, State
from tests.benchmarks.harness import ROOT, Row, Run
from tests.benchmarks.image_measures import measures
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.numerical.scene_frames import scene_view

MINUTES = 1.5
PICTURES = ROOT / "tests" / "data" / "published_pipeline.npz"
SIZE, FOV_DEG = (128, 72), 12.0
STATE = State(5.0, 0.5)
METHODS = {
    "published": ({"pipeline": "published"}, {}),
    "exact PSFs": ({"grid": "paper"}, {"accumulation": "paper"}),
    "exact": ({}, {}),
}
"""Settings and frame options; "exact PSFs" has the published grid and accumulation."""

REPEATS, QUICK_REPEATS = 9, 2
QUICK_CONDITIONS = ("emmetropia", "keratoconus")
TIMEOUT_S = 3600.0


@dataclass(frozen=True)
class PipelineRow(Row):
    """A row of one eye and method; ``error`` is the PSNR of linear light.

    Attributes
    ----------
    prepare_ms : float
        From the profile to the PSFs of a first frame.
    psf_count : int
    psnr_srgb8_db : float
    note_values : dict
        Numbers of the notes on the eye, by their code.
    """

    prepare_ms: float
    psf_count: int
    psnr_srgb8_db: float
    note_values: dict[str, dict[str, float]]


def picture_view():
    """Return the view that is filtered."""
    width_px, height_px = SIZE
    return scene_view(
        "primitives", width_px=width_px, height_px=height_px, fov_deg=FOV_DEG
    )


def profile_body(case: str) -> dict:
    """Return a condition with the paper's periphery, and without straylight."""
    return {
        "kind": "preset",
        "name": case,
        "periphery": PERIPHERY,
        "straylight": None,
    }


def exact_picture(case: str) -> NDArray[np.float64]:
    """Return the view through the exact PSF of every pixel, in linear light."""
    view = picture_view()
    state = EyeBench(None, case, [view]).exact_state(STATE, on_axis=False)
    return dense_reference(view, state, bins=False)


def run_method(
    case: str, method: str, exact: NDArray[np.float64], *, repeats: int
) -> tuple[PipelineRow, NDArray[np.float32]]:
    """Filter the view through one eye; the row, and the picture in linear light."""
    view = picture_view()
    state = {"pupil_diameter_mm": STATE.pupil_mm, "focus_dpt": STATE.focus_dpt}
    settings, options = METHODS[method]
    times_ms = []
    with ExitStack() as closing:
        builder = open_inline_builder(closing, engine="native")
        start_s = time.process_time()
        eye_filter = closing.enter_context(
            EyeFilter(
                profile_body(case),
                view.camera,
                settings,
                builder=builder,
            )
        )
        for _ in range(1 + repeats):
            seen = eye_filter.filter(
                view,
                **state,
                **options,
                whole=True,
                output="linear",
                timeout_s=TIMEOUT_S,
            )
            times_ms.append(1e3 * (time.process_time() - start_s))
            start_s = time.process_time()
        prepared = eye_filter.prepared_stores[-1]
    error = measures(seen.color, exact)
    frame_ms = times_ms[1:]
    row = row_of(
        *("published", method, case, f"{SIZE[0]}x{SIZE[1]} {STATE}", frame_ms),
        *("psnr_db", error.psnr_db, "exact PSF of every pixel"),
        kind=PipelineRow,
        prepare_ms=times_ms[0] - float(np.median(frame_ms)),
        psf_count=prepared.store.computed_count,
        psnr_srgb8_db=error.psnr_srgb8_db,
        note_values={note.code: note.values for note in prepared.notes},
    )
    return row, seen.color


def stored_pictures(path: Path = PICTURES) -> dict[str, dict[str, NDArray[np.uint8]]]:
    """Return the pictures of a whole run, by kind ("published", "exact") and eye."""
    with np.load(path) as stored:
        return {
            kind: dict(zip(CONDITIONS, stored[kind], strict=True))
            for kind in ("published", "exact")
        }


def error_db(image: NDArray[np.uint8], reference: NDArray[np.uint8]) -> float:
    """Return the PSNR of linear light of two sRGB pictures."""
    return measures(*(linear_from_srgb(a) for a in (image, reference))).psnr_db


def measure(run: Run) -> list[Row]:
    """Return the rows of six eyes or two, and write the pictures of six."""
    rows, pictures = [], {"published": [], "exact": []}
    for network in ("eye", "focus", "aberration"):
        load_network(network)
    run_method("emmetropia", "published", exact_picture("emmetropia"), repeats=1)
    for case in QUICK_CONDITIONS if run.is_quick else CONDITIONS:
        print(f"{case} ...", file=sys.stderr, flush=True)
        exact = exact_picture(case)
        pictures["exact"].append(srgb_from_linear(exact))
        for method in METHODS:
            repeats = QUICK_REPEATS if run.is_quick else REPEATS
            row, seen = run_method(case, method, exact, repeats=repeats)
            rows.append(row)
            if method == "published":
                pictures[method].append(srgb_from_linear(seen))
    if not run.is_quick and not PICTURES.exists():
        np.savez_compressed(PICTURES, **{k: np.array(v) for k, v in pictures.items()})
    return rows
