"""How true frames are: points of light, energy, color, continuity, edges, crops.

    python -m tests.benchmarks.bench_truth [--quick] [--json] [--engine NAME]

The reference of points is `tests.reference.point_image`: quadrature of the wavefront of
exactly the pixel's direction, distance and state.  Frames have the tolerance 0 unless a
row says otherwise.  Writes results/truth.json.

- point: half the sum of the absolute differences between the image of a pixel of light
  1 and the reference, the worst color, at 12 directions and states, each in the middle
  of a window, and three of them in a wide frame.  On black, points are bright, and
  light beyond kernels is added.  On gray, they are not, and frames are divided by their
  coverage, so that a uniform image stays uniform.
- energy: largest difference of a point's light in the frame from 1.
- step: errors of single steps of the way to a frame.  "Method" is the error of the
  program's PSFs of exactly the pixels; the others are differences from these PSFs.
- color: the setting lateral_color; largest difference between the centroids of red or
  blue minus green in frames and in the reference, 5 to 20 degrees from the axis.
- continuity: least ratio of the changes of a frame while the change of its input is
  halved, down to changes of light of 1e-4; 2 if frames are continuous.
- edge: largest difference of a lamp's light in a frame, 1 to 6 px beside a black edge
  in focus, from the share of its image that does not fall on the nearer surface, in
  green, for which the edge is in focus; and from the share of the pupil's rays to the
  lamp that pass the edge, in all colors and also where the edge is not sharp.
- crop: PSNR of a camera's window, at an odd place, against the full frame, of linear
  light, away from the border.
- far: largest change of distant pixels of a photograph by a lamp of 20 times white,
  less its own light.
"""

import argparse
from collections.abc import Callable

import numpy as np

from filter_service.filtering.eye_filter import EyeFilter
from tests.benchmarks import truth_changes, truth_edges
from tests.benchmarks.engines import ENGINES
from tests.benchmarks.harness import KeptRows, Row, memory_mb, publish
from tests.benchmarks.truth_points import (
    EYES,
    PLACES_DEG,
    STATES,
    WIDE_PX,
    WINDOW_PX,
    PointTruth,
    camera_at,
    lateral_color,
    opened,
    pixel_at,
    point_frames,
)
from tests.benchmarks.truth_steps import Steps

METHODS = {
    # method: settings, goal of the image of a point
    "on-axis": ({"mode": "on-axis"}, 0.01),
    "dynamic": ({"mode": "dynamic"}, 0.03),
    "quality": ({"mode": "quality"}, 0.015),
    "quality fine": ({"mode": "quality", "tolerance": "fine"}, 0.005),
}
ENERGY_GOAL, COLOR_GOAL, RATIO_GOAL, EDGE_GOAL = 0.002, 0.02, 1.8, 0.02
CROP_GOAL_DB, FAR_GOAL = 60.0, 1e-6
COLOR_EYES = {
    "emmetropia": "emmetropia",
    "escudero_sanz": {"kind": "published", "name": "escudero_sanz_navarro_1999"},
    "myopia": "myopia",
}
STEP_EYES = WIDE_EYES = ("emmetropia", "keratoconus")
REFERENCE = "float64 quadrature"
GROUNDS = ("black", "gray")
WIDE_STATE = 1
"""Index of the state of wide frames."""


class Report:
    """Rows, kept in a file as they are found."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.points: list[dict] = []
        self._kept = KeptRows("truth")

    def add(
        self,
        method: str,
        case: str,
        setting: str,
        error_name: str,
        error: float,
        reference: str,
        times_ms=(0.0,),
    ) -> None:
        """Add a row, with the median and the 95th percentile of times."""
        median_ms, p95_ms = (float(t) for t in np.percentile(times_ms, (50, 95)))
        row = Row(
            *("truth", method, case, setting, len(times_ms), median_ms, p95_ms),
            *(memory_mb(), error_name, float(error), reference),
        )
        self.rows.append(row)
        self._kept.add(row)


def add_points(
    report: Report, truth: PointTruth, engine: str, eye_name: str, n_places: int
) -> None:
    """Add the images and the energies of points in windows.

    On the axis, places have the same PSFs: there is one of each state.
    """
    for method, (settings, goal) in METHODS.items():
        frames: dict[str, list] = {ground: [] for ground in GROUNDS}
        for number, place in enumerate(PLACES_DEG[:n_places]):
            state = STATES[number % len(STATES)]
            if method == "on-axis":
                if number >= len(STATES):
                    break
                place = (0.0, 0.0)
            camera = camera_at(*place, WINDOW_PX)
            with opened(eye_name, camera, engine, **settings) as eye_filter:
                pixels = [(WINDOW_PX[0] // 2, WINDOW_PX[1] // 2)]
                for ground, own in frames.items():
                    found = point_frames(
                        *(eye_filter, camera, pixels, state, truth),
                        is_gray=ground == "gray",
                    )
                    own.append((place, state, found[0]))
        for ground, own in frames.items():
            _add_points(report, method, eye_name, f"{ground}, window", goal, own)


def add_wide(report: Report, truth: PointTruth, engine: str, eye_name: str) -> None:
    """Add the images and the energies of points in wide frames."""
    settings, goal = METHODS["quality"]
    camera = camera_at(0.0, 0.0, WIDE_PX)
    places, state = PLACES_DEG[WIDE_STATE :: len(STATES)], STATES[WIDE_STATE]
    pixels = [pixel_at(camera, *place) for place in places]
    with opened(eye_name, camera, engine, **settings) as eye_filter:
        for ground in GROUNDS:
            found = point_frames(
                *(eye_filter, camera, pixels, state, truth), is_gray=ground == "gray"
            )
            own = [*zip(places, [state] * len(places), found, strict=True)]
            _add_points(report, "quality", eye_name, f"{ground}, wide", goal, own)


def _add_points(report, method, eye_name, ground, goal, frames) -> None:
    errors = np.array([frame.errors.max() for _, _, frame in frames])
    energies = np.array([frame.energy_ratio for _, _, frame in frames])
    times_ms = [frame.frame_ms for _, _, frame in frames]
    size = WINDOW_PX if "window" in ground else WIDE_PX
    setting = f"{ground} {size[0]}x{size[1]}"
    for name, error, against in (
        ("point, largest", errors.max(), f"{REFERENCE}; goal {goal:g}"),
        ("point, mean", errors.mean(), REFERENCE),
        (
            "energy, largest",
            np.abs(energies - 1.0).max(),
            f"1; goal {ENERGY_GOAL:g}",
        ),
    ):
        report.add(method, eye_name, setting, name, error, against, times_ms)
    report.points += [
        {
            "method": method,
            "eye": eye_name,
            "ground": ground,
            "place_deg": list(place),
            "state": str(state),
            "edge_light": frame.has_edge_light,
            "errors": np.round(frame.errors, 5).tolist(),
            "energy_ratio": np.round(frame.energy_ratio, 5).tolist(),
        }
        for place, state, frame in frames
    ]


def add_steps(report: Report, truth: PointTruth, eyes, methods, n_places: int) -> None:
    """Add the errors of single steps of the way to a frame."""
    camera = camera_at(0.0, 0.0, WIDE_PX)
    for eye_name in eyes:
        for method in methods:
            settings, _ = METHODS[method]
            with opened(eye_name, camera, "native", **settings) as eye_filter:
                steps = Steps(
                    eye_filter,
                    [pixel_at(camera, *place) for place in PLACES_DEG[:n_places]],
                    [STATES[k % len(STATES)] for k in range(n_places)],
                )
                for step, errors in steps.errors(truth).items():
                    for name in ("largest", "mean"):
                        value = errors.max() if name == "largest" else errors.mean()
                        report.add(
                            *(method, eye_name, step, f"step, {name}", value),
                            REFERENCE if "method" in step else "PSFs of the pixels",
                        )


def add_colors(report: Report, truth: PointTruth, engines, eyes) -> None:
    """Add the lateral color of frames."""
    for eye_name in eyes:
        for engine in engines:
            found = lateral_color(COLOR_EYES[eye_name], engine, truth, "quality")
            for unit, error in (("px", found.error_px), ("mrad", found.error_mrad)):
                report.add(
                    *(f"color, {engine}", eye_name, "quality, 3 mm"),
                    *(f"color, largest, {unit}", error),
                    f"{REFERENCE}; goal {COLOR_GOAL:g}",
                    found.frames_ms,
                )


def add_changes(report: Report, engine: str, eyes, pictures, inputs) -> None:
    """Add the continuity of frames."""
    views = truth_changes.views()
    for picture in pictures:
        for eye_name in eyes:
            found = truth_changes.halvings(
                *(eye_name, views[picture], inputs, engine), tolerances=(0.0, 1.0)
            )
            for (name, tolerance), changes in found.items():
                for measure in ("largest", "rms"):
                    values = getattr(changes, measure)
                    ratio = truth_changes.least_ratio(values)
                    if ratio is None:
                        continue
                    report.add(
                        *(name, eye_name, f"{picture}, tolerance {tolerance:g}"),
                        f"continuity, least ratio of the {measure} change",
                        ratio,
                        f"changes {', '.join(f'{v:.1e}' for v in values)}; "
                        f"goal {RATIO_GOAL:g}",
                    )


def add_edges(report: Report, truth: PointTruth, engine: str, eyes) -> None:
    """Add the energy of lamps beside edges."""
    for eye_name in eyes:
        found = truth_edges.lamp_energies(eye_name, engine, truth)
        for (place, layers, tolerance), energies in found.items():
            for name, error, against in (
                ("edge, green", energies.seen - energies.image, "share of the image"),
                ("edge, all colors", energies.seen - energies.rays, "share of rays"),
            ):
                if name == "edge, green":  # the color of the focus
                    error = error[:, 1]
                report.add(
                    *(f"lamp {place}", eye_name, f"{layers}, tolerance {tolerance:g}"),
                    *(f"{name}, largest difference", np.abs(error).max()),
                    f"{against} that is not hidden; goal {EDGE_GOAL:g}",
                )


def add_crops(report: Report, engine: str, eyes, modes) -> None:
    """Add windows of frames against full frames."""
    for eye_name in eyes:
        for mode in modes:
            found = truth_edges.crop_errors_db(eye_name, engine, mode=mode)
            for tolerance, error_db in found.items():
                report.add(
                    *(f"crop, {mode}", eye_name, f"tolerance {tolerance:g}"),
                    *("crop, dB", error_db, f"full frame; goal {CROP_GOAL_DB:g}"),
                )


def add_far(report: Report, truth: PointTruth, engine: str, eyes) -> None:
    """Add the change of distant pixels by a lamp."""
    for eye_name in eyes:
        found = truth_edges.far_changes(eye_name, engine, truth)
        for (at, tolerance), change in found.items():
            report.add(
                *(f"lamp {at}", eye_name, f"tolerance {tolerance:g}"),
                *("far, largest change", change),
                f"the lamp's own light; goal {FAR_GOAL:g}",
            )


def parts(arguments, report: Report) -> dict[str, Callable[[], None]]:
    """Return the parts of the benchmark by name."""
    truth, engine, quick = PointTruth(), arguments.engine, arguments.quick
    eyes = EYES[3:4] if quick else EYES
    modes = ("dynamic",) if quick else ("on-axis", "dynamic", "quality")
    n_places = 2 if quick else len(PLACES_DEG)

    def points() -> None:
        for eye_name in eyes:
            add_points(report, truth, engine, eye_name, n_places)
            if eye_name in WIDE_EYES:
                add_wide(report, truth, engine, eye_name)

    return {
        "points": points,
        "steps": lambda: add_steps(
            report, truth, eyes if quick else STEP_EYES, tuple(METHODS)[-1:], n_places
        ),
        "colors": lambda: add_colors(
            *(report, truth, ENGINES[:1] if quick else ENGINES),
            tuple(COLOR_EYES)[: 1 if quick else None],
        ),
        "changes": lambda: add_changes(
            *(report, engine, eyes),
            ("photograph",) if quick else ("courtyard", "photograph"),
            tuple(truth_changes.STEPS),
        ),
        "edges": lambda: add_edges(
            *(report, truth, engine),
            tuple(truth_edges.EDGES_DPT)[: 1 if quick else None],
        ),
        "crops": lambda: add_crops(report, engine, eyes, modes),
        "far": lambda: add_far(report, truth, engine, eyes[:1]),
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye, fewer states")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--only", action="append", help="a part, such as points")
    arguments = parser.parse_args()
    report = Report()
    with EyeFilter(engine=arguments.engine):  # keeps the build worker of all others
        for name, part in parts(arguments, report).items():
            if not arguments.only or name in arguments.only:
                part()
    is_whole = not (arguments.quick or arguments.only or arguments.engine != ENGINES[0])
    publish(
        *("truth", report.rows),
        as_json=arguments.json,
        is_whole=is_whole,
        details={"points": report.points},
    )


if __name__ == "__main__":
    main()
