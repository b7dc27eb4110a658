"""How true frames are: points of light, energy, continuity, edges.

The reference of points is `tests.reference.point_image`: quadrature of the wavefront of
exactly the pixel's direction, distance and state.  Frames have the tolerance 0 unless a
row says otherwise.

- point: half the sum of the absolute differences between the image of a pixel of light
  1 and the reference, the worst color, at 4 directions and states, each in the middle
  of a window.  On black, points are bright, and light beyond kernels is added.  On
  gray, they are not, and frames are divided by their coverage, so that a uniform image
  stays uniform.
- energy: largest difference of a point's light in the frame from 1.
- continuity, of three eyes: least ratio of the changes of a frame while the change of
  its input is halved, down to changes of light of 1e-4; 2 if frames are continuous.
  Two of the eyes also have the tolerance 0, whose frames take seconds.
- edge: largest difference of a lamp's light in a frame, 1 to 6 px beside a black edge
  in focus, from the share of its image that does not fall on the nearer surface, in
  green, for which the edge is in focus; and from the share of the pupil's rays to the
  lamp that pass the edge, in all colors and also where the edge is not sharp.
"""

from collections.abc import Iterator

import numpy as np

from filter_service.filtering.eye_filter import EyeFilter
from tests.benchmarks import truth_changes, truth_edges
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.benchmarks.truth_points import (
    PLACES_DEG,
    STATES,
    WINDOW_PX,
    PointTruth,
    camera_at,
    opened,
    point_frame,
)

MINUTES = 9
METHODS = {
    # method: settings, goal of the image of a point
    "on-axis": ({"mode": "on-axis"}, 0.01),
    "dynamic": ({"mode": "dynamic"}, 0.03),
    "quality": ({"mode": "quality"}, 0.015),
    "quality fine": ({"mode": "quality", "tolerance": "fine"}, 0.005),
}
CHANGED_EYES = {"emmetropia": (0.0, 1.0), "myopia": (1.0,), "keratoconus": (0.0, 1.0)}
"""Tolerances of the eyes whose frames change."""
ENERGY_GOAL, RATIO_GOAL, EDGE_GOAL = 0.002, 1.8, 0.02
REFERENCE = "float64 quadrature"
ENGINE = "native"


def _row(method, case, setting, error_name, error, reference, times_ms=()) -> Row:
    return row_of(
        *("truth", method, case, setting, times_ms, error_name, error, reference)
    )


def point_rows(truth: PointTruth, eye: str, methods, n_places: int) -> Iterator[Row]:
    """Yield the errors of the images and the energies of points in windows.

    On the axis, places have the same PSFs: there is one of each state.
    """
    for method in methods:
        settings, goal = METHODS[method]
        frames: dict[str, list] = {"black": [], "gray": []}
        for number, place in enumerate(PLACES_DEG[:n_places]):
            state = STATES[number % len(STATES)]
            if method == "on-axis":
                if number >= len(STATES):
                    break
                place = (0.0, 0.0)
            camera = camera_at(*place, WINDOW_PX)
            with opened(eye, camera, ENGINE, **settings) as eye_filter:
                for ground, own in frames.items():
                    is_gray = ground == "gray"
                    own.append(
                        point_frame(eye_filter, camera, state, truth, is_gray=is_gray)
                    )
        for ground, own in frames.items():
            errors = np.array([frame.errors.max() for frame in own])
            energies = np.array([frame.energy_ratio for frame in own])
            for name, error, against in (
                ("point, largest", errors.max(), f"{REFERENCE}; goal {goal:g}"),
                ("point, mean", errors.mean(), REFERENCE),
                (
                    "energy, largest",
                    np.abs(energies - 1.0).max(),
                    f"1; goal {ENERGY_GOAL:g}",
                ),
            ):
                yield _row(
                    *(method, eye, f"{ground}, window {WINDOW_PX[0]}x{WINDOW_PX[1]}"),
                    *(name, error, against, [frame.frame_ms for frame in own]),
                )


def change_rows(eye: str, picture: str, inputs, tolerances) -> Iterator[Row]:
    """Yield the continuity of frames."""
    view = truth_changes.views()[picture]
    found = truth_changes.halvings(eye, view, inputs, ENGINE, tolerances=tolerances)
    for (name, tolerance), changes in found.items():
        for measured, values in changes.items():
            ratio = truth_changes.least_ratio(values)
            if ratio is not None:
                yield _row(
                    *(name, eye, f"{picture}, tolerance {tolerance:g}"),
                    *(f"continuity, least ratio of the {measured} change", ratio),
                    f"changes {', '.join(f'{v:.1e}' for v in values)}; "
                    f"goal {RATIO_GOAL:g}",
                )


def edge_rows(truth: PointTruth, eye: str) -> Iterator[Row]:
    """Yield the energy of lamps beside edges."""
    found = truth_edges.lamp_energies(eye, ENGINE, truth)
    for (place, layers, tolerance), (seen, image, rays) in found.items():
        for name, error, against in (
            # the color of the focus
            ("edge, green", (seen - image)[:, 1], "share of the image"),
            ("edge, all colors", seen - rays, "share of rays"),
        ):
            yield _row(
                *(f"lamp {place}", eye, f"{layers}, tolerance {tolerance:g}"),
                *(f"{name}, largest difference", np.abs(error).max()),
                f"{against} that is not hidden; goal {EDGE_GOAL:g}",
            )


def measure(run: Run) -> list[Row]:
    """Return the rows of all parts."""
    truth, rows = PointTruth(), []
    with EyeFilter(engine=ENGINE):  # keeps the build worker of all others
        if run.is_quick:
            rows += point_rows(truth, "emmetropia", ("on-axis",), 1)
            rows += change_rows("emmetropia", "courtyard", ("pupil",), (1.0,))
            return rows
        for eye in CONDITIONS:
            rows += point_rows(truth, eye, METHODS, len(STATES))
        for eye, tolerances in CHANGED_EYES.items():
            inputs = tuple(truth_changes.STEPS)
            rows += change_rows(eye, "courtyard", inputs, tolerances)
        rows += change_rows(
            "emmetropia", "photograph", ("depth noise", "pupil"), (1.0,)
        )
        for eye in truth_edges.EDGES_DPT:
            rows += edge_rows(truth, eye)
    return rows
