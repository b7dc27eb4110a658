"""Changes of frames while the change of their input is halved, for `bench_truth`."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from filter_service.rgbd_view import RgbdView
from tests.benchmarks.photograph import motorcycle
from tests.benchmarks.truth_points import eye_of, opened
from tests.benchmarks.view_sources import linear_color
from tests.numerical.scene_frames import scene_view

SIZE_PX = 160, 90
STEP_COUNT = 6
LEAST_CHANGE = 1e-4
"""Changes of light below which ratios do not count."""

PUPIL_MM = 4.3
NEARER_DPT = 0.9
"""Distance of the focus from the far point: in every eye, the focus can change."""

GAZE_RANGE_DEG = 5.0


def views() -> dict[str, RgbdView]:
    """Return a courtyard and a photograph in linear light."""
    courtyard = scene_view("courtyard", width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    color, depth_m = motorcycle(4 * SIZE_PX[0], 4 * SIZE_PX[1])
    rows, columns = slice(0, 4 * SIZE_PX[1], 4), slice(0, 4 * SIZE_PX[0], 4)
    pictures = {
        "courtyard": courtyard,
        "photograph": RgbdView(
            np.ascontiguousarray(color[rows, columns]),
            np.ascontiguousarray(depth_m[rows, columns]),
            courtyard.tangents,
        ),
    }
    return {
        name: RgbdView(
            linear_color(view).astype(np.float32), view.depth_m, view.tangents
        )
        for name, view in pictures.items()
    }


def least_ratio(changes: NDArray[np.float64]) -> float | None:
    """Return the least ratio of consecutive changes, down to `LEAST_CHANGE`.

    It is 2 if the frame changes in proportion to the step, and None if no second change
    is as large.
    """
    pairs = changes[1:] >= LEAST_CHANGE
    ratios = changes[:-1][pairs] / changes[1:][pairs]
    return float(ratios.min()) if ratios.size else None


def _with_noise(view: RgbdView, ratio: float) -> RgbdView:
    noise = np.random.default_rng(5).uniform(-1.0, 1.0, view.depth_m.shape)
    depth_m = (view.depth_m * (1.0 + ratio * noise)).astype(np.float32)
    return RgbdView(view.color, depth_m, view.tangents)


STEPS: dict[str, tuple[float, Callable]] = {
    "depth noise": (0.005, lambda step: (step, {})),
    "pupil": (0.05, lambda step: (0.0, {"pupil_diameter_mm": step})),
    "focus": (0.05, lambda step: (0.0, {"focus_dpt": step})),
    "gaze": (0.5, lambda step: (0.0, {"gaze_deg": (step, 0.6 * step)})),
}
"""First step of each input, in its unit, and what it adds: noise, arguments.  After a
larger step, the largest change is not in proportion: an edge has passed a pixel."""


def halvings(
    eye_name: str,
    view: RgbdView,
    inputs: tuple[str, ...],
    engine: str,
    *,
    tolerances: tuple[float, ...],
) -> dict[tuple[str, float], dict[str, NDArray[np.float64]]]:
    """Return the changes of a frame by input and tolerance.

    They are the "largest" and the "rms" change of light (n,), from the largest step to
    the smallest.
    """
    found = {}
    for is_gaze in (False, True):
        own = [name for name in inputs if (name == "gaze") == is_gaze]
        if not own:
            continue
        reach_deg = GAZE_RANGE_DEG if is_gaze else 0.0
        settings = {
            "mode": "dynamic",
            "focus_range_dpt": (0.0, 10.0),
            "gaze_range_deg": (reach_deg, reach_deg),
        }
        with opened(eye_name, view.camera, engine, **settings) as eye_filter:
            far_dpt, _ = eye_of(eye_filter).focus_limits_dpt(PUPIL_MM)
            focus_dpt = max(far_dpt, 0.0) + NEARER_DPT

            def frame(name, step, tolerance, filter_=eye_filter, focus_dpt=focus_dpt):
                noise, added = STEPS[name][1](step)
                return filter_.filter(
                    _with_noise(view, noise) if noise else view,
                    pupil_diameter_mm=PUPIL_MM + added.get("pupil_diameter_mm", 0.0),
                    focus_dpt=focus_dpt + added.get("focus_dpt", 0.0),
                    gaze_deg=added.get("gaze_deg"),
                    output="linear",
                    render_tolerance=tolerance,
                ).color.astype(np.float64)

            for name in own:
                first = STEPS[name][0]
                for tolerance in tolerances:
                    still = frame(name, 0.0, tolerance)
                    changes = [
                        frame(name, first / 2.0**k, tolerance) - still
                        for k in range(STEP_COUNT)
                    ]
                    found[name, tolerance] = {
                        "largest": np.array([np.abs(c).max() for c in changes]),
                        "rms": np.array([np.sqrt(np.mean(c**2)) for c in changes]),
                    }
    return found
