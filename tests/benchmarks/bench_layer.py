r"""What the OpenXR layer adds to a program's frames, and how old filtered frames are.

    sh tests/headset/run_in_root.sh env OCUFILTER_COMMIT=$(git rev-parse --short HEAD) \
        python -m tests.benchmarks layer

The application of tests/openxr_layer on its mock runtime, at 72 frames a second, with
depth, in OpenGL and in Vulkan by Mesa on the processor: without the layer; with the
layer but no helper; with a helper that takes every frame and filters none, at once; and
with one that filters through a myope's left and a keratoconic right eye, on the same
cores.

``release + end`` is the time of all calls that release an image or end a frame, of both
views, whatever they wait for; the runtime waits in them for the application's drawing.
``added`` is the difference of its medians to those without the layer.  Stages are what
the layer tells: ``copy`` of color and depth at release, which also waits for the
drawing; ``read`` into shared memory, ``upload`` of a result, and ``other`` per frame;
``helper`` is from a frame's arrival to its result.  ``age`` is from a frame's display
time to that of the frame in whose place it is shown.

The error is the peak signal-to-noise ratio, of 8 bits, of the last pictures to the same
frame filtered with no tolerance for errors of rendering; infinite for unfiltered ones.
"""

import contextlib
import tempfile
from pathlib import Path

import numpy as np

from clients.headset.stereo_filter import FilteredStereoFrame, LocalFilter
from clients.headset.stereo_gaze import StereoGaze
from tests.benchmarks import harness
from tests.benchmarks.bench_headset import PROFILES, SETTINGS, error_db
from tests.benchmarks.harness import Row, memory_mb
from tests.benchmarks.rows import row_of
from tests.end_to_end.layer_double import RunningHelper
from tests.openxr_layer import build
from tests.openxr_layer.layered import layer_environment
from tests.openxr_layer.programs import Run

MINUTES = 6
APIS = {"OpenGL": (), "Vulkan": ("--vulkan", "2")}
SIZES_PX = ((448, 504), (896, 1007))
QUICK_SIZES_PX = ((112, 126),)
RATE_HZ = 72
N_FRAMES, QUICK_FRAMES = 1000, 600
SETTLED = 0.5  # of the frames, by which eyes are ready
REFERENCE = "no tolerance for errors of rendering"
STAGES = ("copy", "read", "upload", "other", "helper")


class Unprepared:
    """Filter that has no eyes yet."""

    settings = None

    def see(self, _frame) -> None:
        """Return no result."""

    def restart(self) -> None:
        """There is nothing to discard."""

    def close(self) -> None:
        """There is nothing to release."""


class Bench:
    """The application with and without the layer, at one size, in one API."""

    def __init__(
        self, folder: Path, api: str, size_px: tuple[int, int], n_frames: int
    ) -> None:
        self._folder, self._api, self._n_frames = folder, api, n_frames
        self._socket = folder / "layer.sock"
        self._runtime = build.build_runtime(folder)
        self._driver = build.build_driver(folder)
        self._layered = layer_environment(
            build.build_layer(folder), folder, self._socket
        )
        self._size = "{}x{}".format(*size_px)
        self.case = f"{api}, 2 x {self._size}"
        head = folder / "head.txt"
        places = (f"{1e-4 * i} 0 0 0 0 0 1" for i in range(n_frames + 100))
        head.write_text("\n".join(places))
        self._variables = {
            "MOCK_XR_SIZE": self._size,
            "MOCK_XR_RATE_HZ": str(RATE_HZ),
            "MOCK_XR_HEAD": str(head),
            "MOCK_XR_CAPTURE_EVERY": "100000",
        }

    def run(self, *, is_layered: bool) -> Run:
        """Run the application; return it when it has ended."""
        own = self._layered if is_layered else {}
        options = ("plain", "--frames", self._n_frames, "--size", self._size)
        options += APIS[self._api]
        ran = Run(
            self._runtime,
            self._folder,
            self._driver,
            *options,
            **own,
            **self._variables,
        )
        if ran.exit_code != 0 or ran.violations:
            raise SystemExit(ran.said[-2000:])
        return ran

    def row(self, method, setting, times_ms, error=float("inf")) -> Row:
        """Return a row of times."""
        return row_of(
            *("layer", method, self.case, setting, times_ms),
            *("PSNR dB", error, REFERENCE),
        )

    def copied(self) -> tuple[Run, dict]:
        """Run it with a helper that filters nothing; return it, and what that told."""

        def made(_say):
            return Unprepared(), StereoGaze(age_years=30.0)

        with RunningHelper(self._socket, made) as helper:
            ran = self.run(is_layered=True)
            return ran, helper.helper.report()

    def filtered(self) -> tuple[Run, dict, FilteredStereoFrame]:
        """Run it with a helper; return it, the helper's report and the last result."""
        seen = {}

        def made(say):
            seeing = LocalFilter(SETTINGS, say)
            for eye, profile in PROFILES.items():
                seeing.change(eye, profile)
            return seeing, StereoGaze(age_years=30.0)

        with RunningHelper(self._socket, made, max_age_ms=5000) as helper:
            helper.helper.on_frame = lambda _, result: seen.update(last=result)
            ran = self.run(is_layered=True)
            report = helper.helper.report()
        return ran, report, seen["last"]


def call_times_ms(ran: Run) -> np.ndarray:
    """Return the time of the calls that release images and end frames, per frame."""
    lines = [line for line in ran.told if "frame" in line]
    return np.array([line["release_ms"] + line["end_frame_ms"] for line in lines])


def ages_ms(ran: Run) -> np.ndarray:
    """Return by how much older the frame is that is shown; by poses, 0 without."""
    told = [line for line in ran.told if "frame" in line]
    number = {}
    for i, line in enumerate(told):
        number[tuple(map(float.fromhex, line["views"][0][:7]))] = i
    shown = {frame["display_time"]: frame for frame in ran.frames}
    ages = []
    for i, line in enumerate(told):
        view = shown[line["display_time"]]["layers"][0]["views"][0]
        ages.append((i - number[tuple(view["pose"])]) / RATE_HZ)
    return 1e3 * np.array(ages)


def stage_rows(bench, method, told, names, error=float("inf")) -> list[Row]:
    """Return rows of the stages that a helper reports."""
    rows = []
    for name in names:
        found, n = told["stages_ms"][f"{name}_ms"], told["filtered"]
        rows.append(
            Row(
                *("layer", method, bench.case, name, n or told["not_filtered"]),
                *(found["p50"], found["p95"], memory_mb()),
                *("PSNR dB", error, REFERENCE),
            )
        )
    return rows


def rows_of(api: str, size_px: tuple[int, int], n_frames: int) -> list[Row]:
    """Return the rows of one size, in one API."""
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), api, size_px, n_frames)
        settled = slice(int(SETTLED * n_frames), None)
        plain = call_times_ms(bench.run(is_layered=False))[settled]
        idle = call_times_ms(bench.run(is_layered=True))[settled]
        taken, taken_told = bench.copied()
        ran, told, last = bench.filtered()
    busy, ages = call_times_ms(ran)[settled], ages_ms(ran)[settled]
    base = np.median(plain)
    error = error_db(last, contextlib.nullcontext())  # of arrays
    rows = [
        bench.row("no layer", "release + end", plain),
        bench.row("layer, no helper", "release + end", idle),
        bench.row("layer, no helper", "added", idle - base),
        bench.row("layer, copies", "added", call_times_ms(taken)[settled] - base),
        *stage_rows(bench, "layer, copies", taken_told, ("copy", "read", "other")),
        bench.row("layer, helper", "release + end", busy, error),
        bench.row("layer, helper", "added", busy - base, error),
    ]
    rows += stage_rows(bench, "layer, helper", told, STAGES, error)
    is_old = ages > 0
    rows.append(bench.row("layer, helper", "age", ages[is_old], error))
    share = (
        f"{told['submitted']} submitted, {told['filtered']} filtered, "
        f"{told['shown_filtered']} shown filtered, {told['fallback']} fallback"
    )
    rows.append(bench.row("layer, helper", share, ages[is_old], error))
    return rows


def measure(run: harness.Run) -> list[Row]:
    """Return the rows of all sizes and interfaces, or of one small size."""
    sizes_px = QUICK_SIZES_PX if run.is_quick else SIZES_PX
    n_frames = QUICK_FRAMES if run.is_quick else N_FRAMES
    return [
        row
        for size_px in sizes_px
        for api in list(APIS)[: 1 if run.is_quick else None]
        for row in rows_of(api, size_px, n_frames)
    ]
