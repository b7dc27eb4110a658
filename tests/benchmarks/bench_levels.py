"""Image error at each level of the setting `tolerance`: percentiles over blocks.

A photograph and the two scenes, at 320x180 and 50 degrees, each in one state through
six eyes, with the grid of the default ranges.  Each picture is compared with the
dense reference as encoded for a screen, in blocks of 32x32 pixels; a row states what
5 % of the blocks fall below, with the median and the worst block beside it, and the
PSFs and the time that a frame took.  Beside the levels stands a grid for one state and
the picture's distances alone, whose kernels keep 0.998 of their light: as exact as a
picture can be planned at the usual tolerance.
"""

import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import object_range_dpt
from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import TOLERANCES, FilterSettings
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.benchmarks.stream_walks import photograph_walk
from tests.benchmarks.view_sources import EyeState
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import SCENES, scene_view

MINUTES = 5.5
ONE_STATE = "one state"
SIZE_PX, BLOCK_PX = (320, 180), 32
STATES = ((3.0, 0.3), (5.0, 1.2), (3.0, 0.3))
"""Pupil (mm) and focus (dpt) of each picture."""

REFERENCE = "dense reference, encoded"


def views(size_px: tuple[int, int]) -> list[RgbdView]:
    """Return the pictures."""
    photograph = photograph_walk(size_px, 1, 1.0)[0].view
    size = dict(zip(("width_px", "height_px"), size_px, strict=True))
    return [photograph, *(scene_view(name, **size) for name in SCENES)]


def encoded(linear: NDArray) -> NDArray[np.float64]:
    """Return light as a screen is sent it, 0 to 1."""
    return srgb_from_linear(linear) / 255.0


def block_db(seen: NDArray, truth: NDArray) -> NDArray[np.float64]:
    """PSNR of each whole block."""
    rows, columns = (n // BLOCK_PX for n in seen.shape[:2])
    error = (encoded(seen) - encoded(truth))[: rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = (error**2).reshape(rows, BLOCK_PX, columns, BLOCK_PX, -1)
    return -10.0 * np.log10(np.maximum(blocks.mean(axis=(1, 3, 4)).ravel(), 1e-12))


def leveled(
    level: str, eye_name: str, view: RgbdView, pupil_mm: float, focus_dpt: float
) -> PsfStore:
    """Return an empty store of a level, for a view in a state."""
    settings, options = {"tolerance": level}, {}
    if level == ONE_STATE:
        options = {"kept_energy_ratio": 0.998}
        settings = {
            "pupil_range_mm": (pupil_mm, pupil_mm),
            "focus_range_dpt": (focus_dpt, focus_dpt),
            "object_range_dpt": object_range_dpt(view),
        }
    spec = GridSpec(view.camera, FilterSettings(**settings), **options)
    eye = traced_eye(eye_name, spec)
    return PsfStore(eye, spec, unchecked_plan(eye, spec, predict=False))


def level_rows(eyes, tolerances, pictures, states) -> Iterator[Row]:
    """Yield rows of each level: of each eye, and of all eyes together."""
    renderer = NativeRenderer()
    for tolerance in tolerances:
        every: dict[str, tuple[list[NDArray], list[float], int]] = {}
        for name in eyes:
            blocks, times_ms, count = [], [], 0
            for view, (pupil_mm, focus_dpt) in zip(pictures, states, strict=True):
                store = leveled(tolerance, name, view, pupil_mm, focus_dpt)
                handle = renderer.load(store)
                state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt}
                renderer.render(view, handle, **state)
                begin_s = time.perf_counter()
                seen = renderer.render(view, handle, **state)
                times_ms.append(1e3 * (time.perf_counter() - begin_s))
                exact = EyeState(store.eye, store.spec, pupil_mm, focus_dpt)
                truth = dense_reference(view, exact, bins=True)
                blocks.append(block_db(seen.color, truth))
                count += store.computed_count
            every[name] = blocks, times_ms, count
        every["all eyes"] = tuple(
            sum(parts[1:], parts[0]) for parts in zip(*every.values(), strict=True)
        )
        for case, (blocks, times_ms, count) in every.items():
            own_db = np.concatenate(blocks)
            for what, value_db in (
                ("5 % of blocks, dB", np.percentile(own_db, 5)),
                ("median block, dB", np.median(own_db)),
                ("worst block, dB", own_db.min()),
            ):
                yield row_of(
                    *("levels", tolerance, case, f"{count} PSFs", times_ms),
                    *(what, value_db, REFERENCE),
                    n=own_db.size,
                )


def measure(run: Run) -> list[Row]:
    """Return the rows of all levels, or of one eye, picture, state and level."""
    if run.is_quick:
        pictures = views((96, 64))[:1]
        return [*level_rows(CONDITIONS[:1], TOLERANCES[1:2], pictures, STATES[:1])]
    return [*level_rows(CONDITIONS, (*TOLERANCES, ONE_STATE), views(SIZE_PX), STATES)]
