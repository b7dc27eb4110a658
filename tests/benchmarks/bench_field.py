"""The paper's method and its predecessors, by error, time, work and memory.

Six eyes, two scenes and all methods at 640x360; at 1280x720 the renderer on the axis
for all of them, where the reference is quick, and the renderer's modes and Barsky's
method in the courtyard for two eyes.

The reference (`dense_reference`) of methods on the axis has the PSF of the axis
everywhere; that of the others follows the visual field.  Methods for any pupil and
focus are also measured in the courtyard at random ones, another one for each eye, so
nearly always between nodes.  Time is that of a frame whose pupil and focus differ from
those of the frame before, so that its kernels are made anew (`frame_runs`); methods
that convolve are timed likewise, with the PSFs of the new state.  The paper's layouts
have counted PSF samples and no time: they are scatters without tiles or merging, which
would be another method's time.  ``error`` is the PSNR of linear light; that of 8-bit
images stands beside it, as in the paper.

References are kept under out/dense_references; they and methods without a time are
computed on all cores, before anything is timed.  A whole run also plots field.png:
error against time and memory, medians over eyes, scenes and states.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import (
    FOCUS_RANGE_DPT,
    METHODS,
    PAPER_RANGES,
    EyeBench,
    Method,
    State,
)
from tests.benchmarks.harness import Row, Run, written_path
from tests.benchmarks.image_measures import measures
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.numerical.scene_frames import SCENES, scene_view

MINUTES = 29
FIXED = State(5.0, 0.5)
SEED = 5
REPEATS = 3

UNBINNED_PIXEL_COUNT = 60_000
"""Larger frames are compared with the binned reference over the field; on the axis all
are: there it has bins of distance alone, and is 50 times as quick."""

TARGETS_DB = {
    "ours on-axis": 46.0,
    "ours on-axis wide": 46.0,
    "ours quality": 45.0,
    "ours dynamic": 44.0,
}
"""Linear PSNR that no row of a method may miss."""


@dataclass(frozen=True)
class Part:
    """Eyes, scenes and methods that a size is measured for.

    Attributes
    ----------
    random_count : int
        Random states of each eye and scene.
    """

    size: tuple[int, int]
    eyes: tuple[str, ...] = CONDITIONS
    scenes: tuple[str, ...] = SCENES
    methods: tuple[Method, ...] = METHODS
    random_count: int = 1

    @property
    def name(self) -> str:
        """Size in words."""
        return f"{self.size[0]}x{self.size[1]}"


ON_AXIS = tuple(m for m in METHODS if m.name.startswith("ours on-axis"))
LARGE = tuple(
    m for m in METHODS if m.name in ("ours quality", "ours dynamic", "Barsky")
)
PARTS = (
    Part((640, 360), scenes=SCENES[:1]),
    Part((640, 360), scenes=SCENES[1:], random_count=0),
    Part((1280, 720), methods=ON_AXIS, random_count=0),
    Part((1280, 720), ("myopia", "keratoconus"), SCENES[:1], LARGE, random_count=0),
)
QUICK_PARTS = (Part((96, 54), ("emmetropia",), SCENES[:1], random_count=0),)


@dataclass(frozen=True)
class FieldRow(Row):
    """A row with further figures.

    Attributes
    ----------
    scene, size : str
    psnr_srgb8_db : float
        Of 8-bit sRGB; ``error`` is the linear PSNR.
    prepare_ms : float
        PSFs of the eye, once.
    psf_count : int
    tap_count : int or None
        PSF samples that the frame needs, where they are counted: those within the
        square of a PSF.
    """

    scene: str
    size: str
    psnr_srgb8_db: float
    prepare_ms: float
    psf_count: int
    tap_count: int | None


def random_states(eye: str, scene: str, size: str, count: int) -> list[State]:
    """Return pupils and foci within all methods' ranges.

    They differ for each eye, scene and size.
    """
    rng = np.random.default_rng([SEED, *f"{eye} {scene} {size}".encode()])
    low_dpt = PAPER_RANGES["focus_range_dpt"][0]
    return [
        State(
            float(rng.uniform(*PAPER_RANGES["pupil_range_mm"])),
            float(rng.uniform(low_dpt, FOCUS_RANGE_DPT[1])),
        )
        for _ in range(count)
    ]


@dataclass(frozen=True)
class Case:
    """A method, a scene and a state of one eye and image size."""

    eye: str
    size: str
    scene: str
    view: RgbdView
    method: Method
    state: State


def cases(eye: str, part: Part) -> list[Case]:
    """Return the cases of one eye and image size."""
    size = dict(zip(("width_px", "height_px"), part.size, strict=True))
    views = {scene: scene_view(scene, **size) for scene in part.scenes}
    return [
        Case(eye, part.name, scene, view, method, state)
        for method in part.methods
        for scene, view in views.items()
        for state in method.states(
            FIXED, random_states(eye, scene, part.name, part.random_count)
        )
    ]


def untimed_rows(eye: str, part: Part) -> dict[int, Row]:
    """Compute all references, and return the rows that have no time, by case.

    This runs on all cores at once, before anything is timed.
    """
    found = {}
    own = cases(eye, part)
    bench = EyeBench(None, eye, [case.view for case in own])
    for number, case in enumerate(own):
        if case.method.timed:
            reference(bench, case)
        else:
            found[number] = method_row(bench, case)
    return found


def timed_rows(renderer, eye: str, part: Part, untimed: dict[int, Row]) -> list[Row]:
    """Return the rows of one eye and image size, with those that have no time."""
    own = cases(eye, part)
    bench = EyeBench(renderer, eye, [case.view for case in own])
    rows = [
        untimed[number] if number in untimed else method_row(bench, case)
        for number, case in enumerate(own)
    ]
    bench.release()
    return rows


def is_binned(case: Case) -> bool:
    """Return whether PSFs of the reference are those of bins."""
    view = case.view
    return case.method.on_axis or view.width_px * view.height_px > UNBINNED_PIXEL_COUNT


def reference(bench: EyeBench, case: Case) -> NDArray[np.float64]:
    """Return the reference (height, width, 3) of a case."""
    exact = bench.exact_state(case.state, on_axis=case.method.on_axis)
    return dense_reference(case.view, exact, bins=is_binned(case))


def method_row(bench: EyeBench, case: Case) -> Row:
    """Return the row of a case."""
    method, scene, size = case.method, case.scene, case.size
    results = method.run(bench, case.view, case.state, REPEATS)
    last, bins = results[-1], is_binned(case)
    error = measures(last.color, reference(bench, case))
    place = "on the axis" if method.on_axis else "over the field"
    psfs = "PSF of every pixel"
    if bins:
        psfs = "bins of " + "0.2 deg and " * (not method.on_axis) + "0.005 dpt"
    return row_of(
        *("field", method.name, case.eye, f"{scene} {size} {case.state}"),
        [result.render_ms for result in results if method.timed],
        *("psnr_db", error.psnr_db, f"dense, {place}, {psfs}"),
        used_mb=last.memory_mb,
        kind=FieldRow,
        scene=scene,
        size=size,
        psnr_srgb8_db=error.psnr_srgb8_db,
        prepare_ms=last.prepare_ms,
        psf_count=last.psf_count,
        tap_count=last.tap_count or None,
    )


def targets(rows: list[FieldRow]) -> list[dict]:
    """Return for each method with a target its worst row, size by size."""
    found = []
    for method, size in dict.fromkeys((row.method, row.size) for row in rows):
        own = [row for row in rows if (row.method, row.size) == (method, size)]
        if method not in TARGETS_DB:
            continue
        worst = min(own, key=lambda row: row.error)
        found.append(
            {
                "method": method,
                "size": size,
                "target_db": TARGETS_DB[method],
                "worst_db": worst.error,
                "median_db": float(np.median([row.error for row in own])),
                "worst": f"{worst.case} {worst.setting}",
                "below": sum(row.error < TARGETS_DB[method] for row in own),
                "n": len(own),
            }
        )
    return found


def plot_errors(rows: list[FieldRow], path: Path) -> None:
    """Plot the error against time and memory; points are medians of a size."""
    figure = Figure(figsize=(14, 7), layout="constrained")
    names = dict.fromkeys(row.method for row in rows)
    palette = mpl.colormaps["tab20"](np.arange(20))
    colors = dict(zip(names, np.resize(palette, (len(names), 4)), strict=True))
    for axes, column, label in zip(
        figure.subplots(1, 2),
        ("median_ms", "memory_mb"),
        ("time of a frame in a new state, ms", "memory of PSFs, MB"),
        strict=True,
    ):
        for name in names:
            own = [r for r in rows if r.method == name and r.median_ms == r.median_ms]
            if column == "memory_mb":
                own = [row for row in rows if row.method == name]
            points = sorted(median_points(own, column))
            if points:
                (line,) = axes.loglog(*zip(*points, strict=True), "o-", c=colors[name])
                line.set_label(name)
        axes.set(xlabel=label, ylabel="RMS error, linear light")
        axes.grid(which="both", alpha=0.3)
        axes.legend(fontsize="x-small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def median_points(rows: list[FieldRow], column: str) -> list[tuple[float, float]]:
    """Return the median of a column, and of the RMS error, of each size."""
    groups = [
        [row for row in rows if row.size == size]
        for size in dict.fromkeys(row.size for row in rows)
    ]
    return [
        (
            float(np.median([getattr(row, column) for row in own])),
            float(10.0 ** (-np.median([row.error for row in own]) / 20.0)),
        )
        for own in groups
    ]


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return the rows of all parts; a row that two of them have counts once."""
    parts = QUICK_PARTS if run.is_quick else PARTS
    jobs = [(eye, part) for part in parts for eye in part.eyes]
    with ProcessPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        untimed = []
        for (eye, part), found in zip(
            jobs, pool.map(untimed_rows, *zip(*jobs, strict=True)), strict=True
        ):
            print(f"{part.name} {eye}: references", file=sys.stderr, flush=True)
            untimed.append(found)
    rows, renderer = {}, NativeRenderer()
    for (eye, part), own in zip(jobs, untimed, strict=True):
        print(f"{part.name} {eye}", file=sys.stderr, flush=True)
        for row in timed_rows(renderer, eye, part, own):
            rows[row.case, row.setting, row.method] = row
    found = list(rows.values())
    if not run.is_quick:
        plot_errors(found, written_path("field.png"))
    return found, {"targets": targets(found)}
