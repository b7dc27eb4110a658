"""The linear operator of a frame and its adjoint: time beside error.

The courtyard at 480x270 and 1280x720 through six eyes, in a constant state.  The frame
without merging, the operator and its adjoint take turns, after the first call of each.
The error of the operator is its largest difference from the frame, relative to the
brightest pixel; that of the adjoint is the difference of <A x, y> and <x, A' y>,
relative to them, for random x and y from 0 to 1.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.profiles.parse import parse_profile
from filter_service.filtering.operator import ViewOperator, operator_options
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.benchmarks.harness import WARM_UPS, Row, Run
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view

MINUTES = 2
SIZES, QUICK_SIZES = ((480, 270), (1280, 720)), ((240, 135),)
COUNTS, QUICK_COUNT = (30, 12), 5
STATE = State(4.5, 0.5)


def linear_view(size_px: tuple[int, int]) -> RgbdView:
    """Return the courtyard in linear light."""
    view = scene_view("courtyard", width_px=size_px[0], height_px=size_px[1])
    return replace(view, color=linear_from_srgb(view.color).astype(np.float32))


def inner(first: NDArray, second: NDArray) -> float:
    """Return the inner product in float64."""
    return float(np.vdot(first.astype(float), second.astype(float)))


def times_in_turns(
    calls: dict[str, Callable[[], object]], count: int
) -> dict[str, NDArray[np.float64]]:
    """Return the times (count,), ms, of calls that take turns."""
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(WARM_UPS + count):
        for name, call in calls.items():
            start_s = time.perf_counter()
            call()
            found[name].append(time.perf_counter() - start_s)
    return {name: 1e3 * np.array(times_s[WARM_UPS:]) for name, times_s in found.items()}


def rows_of(view: RgbdView, name: str, count: int) -> Iterator[Row]:
    """Yield the rows of one eye."""
    profile = parse_profile({"kind": "preset", "name": name})
    spec = grid_spec(
        view.camera,
        mode="dynamic",
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(0.0, 1.0),
    )
    eye, _ = eye_for_spec(profile, spec)
    engine = NativeRenderer()
    handle = engine.load(build_psf_store(eye, spec))
    request = ViewRequest(view, handle, STATE, options=operator_options(1.0))
    operator = ViewOperator.of(request, None)
    rng = np.random.default_rng(0)
    x, y = rng.random((2, *operator.color_shape), dtype=np.float32)
    found: dict[str, NDArray] = {}

    def frame() -> None:
        found["frame"] = engine.begin(request)().color

    def forward() -> None:
        found["forward"] = operator.forward(view.color)

    def adjoint() -> None:
        found["adjoint"] = operator.adjoint(y)

    calls = {"frame": frame, "forward": forward, "adjoint": adjoint}
    times_ms = times_in_turns(calls, count)
    engine.close()
    product = inner(operator.forward(x), y)
    difference = np.abs(found["forward"] - found["frame"]).max()
    errors = {
        "frame": ("none", 0.0, "itself"),
        "forward": (
            "largest difference over brightest",
            float(difference / found["frame"].max()),
            "the frame",
        ),
        "adjoint": (
            "<x, A' y> over <A x, y>, less 1",
            abs(inner(x, found["adjoint"]) / product - 1.0),
            "the operator",
        ),
    }
    setting = f"{view.width_px}x{view.height_px}"
    for method, of_method_ms in times_ms.items():
        yield row_of("operator", method, name, setting, of_method_ms, *errors[method])


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes and sizes, or of one."""
    sizes, counts, eyes = SIZES, COUNTS, CONDITIONS
    if run.is_quick:
        sizes, counts, eyes = QUICK_SIZES, (QUICK_COUNT,), CONDITIONS[:1]
    return [
        row
        for size_px, count in zip(sizes, counts, strict=True)
        for name in eyes
        for row in rows_of(linear_view(size_px), name, count)
    ]
