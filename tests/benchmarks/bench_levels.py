"""Image error at each level of the setting `tolerance`: percentiles over blocks.

    python -m tests.benchmarks.bench_levels [--quick] [--json]

The two scenes and a photograph that is none of ours, at 320x180 and 50 degrees, through
six eyes in two states each, with the lattice of the default ranges.  Each picture is
compared with the dense reference as encoded for a screen, in blocks of 32x32 pixels; a
row says what 5 % of the blocks fall below, with the median and the worst block beside
it, and the PSFs and the time that a frame took.  Beside the levels stands a lattice for
one state and the picture's distances alone, whose kernels keep 0.998 of their light: as
exact as a picture can be planned at the usual tolerance.  Then how steadily pictures
change: of consecutive frames of a walk, the change of the picture over that of the
reference (99th percentile of pairs).  Writes results/levels.json.
"""

import argparse
import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import object_range_dpt
from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import TOLERANCES, FilterSettings
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.stream_walks import photograph_walk
from tests.benchmarks.view_sources import EyeState
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import SCENES, scene_view

ONE_STATE = "one state"
SIZE_PX, BLOCK_PX = (320, 180), 32
STATES = ((3.0, 0.3), (5.0, 1.2))
REFERENCE = "dense reference, encoded"
WALK_SIZE_PX, WALK_FRAMES, WALK_RATE_HZ = (160, 90), 24, 30.0
LEAST_CHANGE = 1e-3
"""RMS change of the reference from which a pair of frames counts."""


def views() -> Iterator[tuple[str, RgbdView]]:
    """Pictures with their names."""
    for name in SCENES:
        yield name, scene_view(name, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    yield "photograph", photograph_walk(SIZE_PX, 1, 1.0)[0].view


def encoded(linear: NDArray) -> NDArray[np.float64]:
    """Return light as a screen is sent it, 0 to 1."""
    return srgb_from_linear(linear) / 255.0


def block_db(seen: NDArray, truth: NDArray) -> NDArray[np.float64]:
    """PSNR of each whole block."""
    rows, columns = (n // BLOCK_PX for n in seen.shape[:2])
    error = (encoded(seen) - encoded(truth))[: rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = (error**2).reshape(rows, BLOCK_PX, columns, BLOCK_PX, -1)
    return -10.0 * np.log10(np.maximum(blocks.mean(axis=(1, 3, 4)).ravel(), 1e-12))


def store_of(
    eye_name: str, camera: Camera, settings: FilterSettings, **options: float
) -> PsfStore:
    """Return an empty store."""
    spec = GridSpec(camera, settings, **options)
    eye = traced_eye(eye_name, spec)
    return PsfStore(eye, spec, unchecked_plan(eye, spec, predict=False))


def leveled(
    level: str, eye_name: str, view: RgbdView, pupil_mm: float, focus_dpt: float
) -> PsfStore:
    """Return an empty store of a level, for a view in a state."""
    if level != ONE_STATE:
        return store_of(eye_name, view.camera, FilterSettings(tolerance=level))
    settings = FilterSettings(
        pupil_range_mm=(pupil_mm, pupil_mm),
        focus_range_dpt=(focus_dpt, focus_dpt),
        object_range_dpt=object_range_dpt(view),
    )
    return store_of(eye_name, view.camera, settings, kept_energy_ratio=0.998)


def level_rows(eyes: tuple[str, ...], tolerances: tuple[str, ...]) -> list[Row]:
    """Rows of each level: of all eyes and pictures together, and of each eye."""
    rows, renderer = [], NativeRenderer()
    pictures = list(views())
    for tolerance in tolerances:
        every: list[NDArray] = []
        times_ms: list[float] = []
        count = 0
        for name in eyes:
            found = []
            for _, view in pictures:
                for pupil_mm, focus_dpt in STATES:
                    store = leveled(tolerance, name, view, pupil_mm, focus_dpt)
                    handle = renderer.load(store)
                    state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
                    renderer.render(view, handle, **state)
                    begin_s = time.perf_counter()
                    seen = renderer.render(view, handle, **state)
                    times_ms.append(1e3 * (time.perf_counter() - begin_s))
                    exact = EyeState(store.eye, store.spec, pupil_mm, focus_dpt)
                    truth = dense_reference(view, exact, bins=True)
                    found.append(block_db(seen.color, truth))
                    count += store.computed_count
            rows += _rows(tolerance, name, found, times_ms[-len(found) :], count)
            every += found
        rows += _rows(tolerance, "all eyes", every, times_ms, count)
    return rows


def _rows(tolerance, case, found, times_ms, count) -> list[Row]:
    blocks = np.concatenate(found)
    median_ms, p95_ms = np.percentile(times_ms, (50, 95))
    return [
        Row(
            *("levels", tolerance, case, f"{count} PSFs", blocks.size),
            *(float(median_ms), float(p95_ms), memory_mb()),
            *(what, float(value), REFERENCE),
        )
        for what, value in (
            ("5 % of blocks, dB", np.percentile(blocks, 5)),
            ("median block, dB", np.median(blocks)),
            ("worst block, dB", blocks.min()),
        )
    ]


def change_row(eye_name: str) -> Row:
    """Return how much more a picture changes from frame to frame than it should."""
    moments = photograph_walk(WALK_SIZE_PX, WALK_FRAMES, WALK_RATE_HZ)
    store = store_of(eye_name, moments[0].view.camera, FilterSettings())
    renderer = NativeRenderer()
    handle = renderer.load(store)
    seen, truth, times_ms = [], [], []
    for moment in moments:
        state = (moment.pupil_diameter_mm, moment.focus_dpt)
        begin_s = time.perf_counter()
        picture = renderer.render(
            moment.view, handle, pupil_diameter_mm=state[0], focus_dpt=state[1]
        )
        times_ms.append(1e3 * (time.perf_counter() - begin_s))
        seen.append(encoded(picture.color))
        exact = EyeState(store.eye, store.spec, *state)
        truth.append(encoded(dense_reference(moment.view, exact, bins=True)))
    ratios = []
    for k in range(1, len(seen)):
        ours, theirs = (
            math.sqrt(float(np.mean((one[k] - one[k - 1]) ** 2)))
            for one in (seen, truth)
        )
        if theirs >= LEAST_CHANGE:
            ratios.append(ours / theirs)
    return Row(
        *("levels", "walk", eye_name, f"{store.computed_count} PSFs", len(ratios)),
        *(float(np.median(times_ms)), float(np.percentile(times_ms, 95)), memory_mb()),
        *("change over reference's, p99", float(np.percentile(ratios, 99))),
        "dense reference of each frame",
    )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye, one level")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    eyes = CONDITIONS[:1] if options.quick else CONDITIONS
    rows = [change_row(name) for name in eyes[:3]]
    levels = TOLERANCES[1:2] if options.quick else TOLERANCES
    rows += level_rows(eyes, (*levels, ONE_STATE))
    publish("levels", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
