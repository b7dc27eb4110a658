"""Frame time on a hardware GPU, of arrays and of textures, with image error.

The courtyard over the whole visual field ("dynamic"), 8-bit sRGB in and out, one eye or
two of a headset.  "moving": pupil and focus change with every frame, so that its
kernels are blended anew; "frozen": they stay.  Frames come one after the other for a
while before any is timed, because an idle GPU lowers its clock.

Color and depth in host memory:

- ``frame``: wall time from the call to the image in host memory;
- ``passes``: the sum of the GPU's timers of the passes, which follow; ``around`` the
  rest of the wall time: copies to and from the GPU, calls of the driver.

Color, depth and image in textures of the caller's context:

- ``frame``: wall time from the call until the GPU has finished the frame;
- ``call``: of it, until the call returns;
- ``gpu``: by a timer of the GPU, from the first command of a frame to the last;
- ``passes``, and each pass: other frames, with a timer around every pass.

Beside each pass stand its counted work and its bound (pass_work).

Error: PSNR in linear light against the native engine, whose loops have no code in
common with the passes; its own error against the dense reference is in live.json.
Images in textures have half floats for it.

Rows go to out/gpu_rows.jsonl as they come, for runs that are ended early.  A whole run
needs a hardware GPU; ``--quick`` runs on any.

``--forecast`` needs none: a forecast, not a measurement, of passes on the GPU of
gpu.json, for frames whose state stays.  It counts the work of each pass as the code now
does it and divides its bound by the mean ratio of bound to time of the measured passes.
The error is the relative deviation from the measured passes, each eye forecast from the
other eyes, and so includes what the code has changed since.
"""

import json
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any
from unittest.mock import patch

import numpy as np

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.renderer import FilterRenderer
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.gpu_cases import (
    EYES,
    FOCUS_DPT,
    PUPIL_MM,
    QUICK_VIEWS,
    REFERENCE,
    STATE,
    VIEWS,
    Case,
    TextureCase,
    open_case,
    view_and_store,
)
from tests.benchmarks.harness import (
    RESULTS,
    KeptRows,
    Row,
    Run,
    memory_mb,
    nvidia_smi,
)
from tests.benchmarks.pass_work import (
    RATES,
    STATE_STAGES,
    FrameWork,
    Rates,
    counted_work,
    rates_of,
)

MINUTES = 4
HOST_STAGES = ("prepare_ms", "psf_plan_ms", "plan_ms", "upload_ms", "readback_ms")
"""Stages that are not passes: by the wall clock, but for the upload, whose timer on the
GPU waits for the processor to copy."""


@dataclass(frozen=True)
class PassRow(Row):
    """A row of a pass: its counted work, and the least time that it takes.

    Attributes
    ----------
    bytes, fetched_bytes, flops, atomics : float
    bound_ms : float or None
        None where the GPU's rates are not known.
    """

    bytes: float
    fetched_bytes: float
    flops: float
    atomics: float
    bound_ms: float | None


Pace = tuple[int, float]
PACE, QUICK_PACE = (60, 1.5), (3, 0.0)
"""How many frames are timed, after how many seconds of others."""


def rows_of(
    case: Case | TextureCase,
    times_ms: dict[str, Any],
    rates: Rates | None,
    *,
    is_moving: bool,
) -> Iterator[Row]:
    """Yield a row for each name; those of passes have their work."""
    works = case.work.passes()
    for name, values in times_ms.items():
        row = Row(
            *("gpu", name, case.eye),
            f"{case.setting} {'moving' if is_moving else 'frozen'}",
            *(len(values), *np.percentile(values, (50, 95)).tolist()),
            *(case.memory_mb, "psnr_db", case.error_db, REFERENCE),
        )
        work = works.get(name.strip()) if name.startswith("    ") else None
        # Of a state that stays, nothing is planned and blended.
        if work is None or (name.strip() in STATE_STAGES and not is_moving):
            yield row
            continue
        bound_ms = None if rates is None else work.bound_ms(rates)
        yield PassRow(**asdict(row), **asdict(work), bound_ms=bound_ms)


def frames_of(
    case: Case | TextureCase, pace: Pace, *, is_moving: bool
) -> Callable[[Callable[[dict], Any]], list]:
    """Return a function that calls another with the state of each frame."""
    count, warm_s = pace
    spec = case.handles[0].store.spec
    states = states_towards(spec, PUPIL_MM, FOCUS_DPT, count if is_moving else 1)

    def frames(function: Callable[[dict], Any]) -> list:
        return [function(states[k % len(states)]) for k in range(count)]

    end_s, n = time.perf_counter() + warm_s, 0
    while time.perf_counter() < end_s or n < 3:
        case.frame(states[n % len(states)])
        n += 1
    return frames


def stage_times(found: list[dict[str, float]]) -> dict[str, list[float]]:
    """Return the times of each stage by name, indented."""
    names = dict.fromkeys(name for stages_ms in found for name in stages_ms)
    return {
        f"    {name.removesuffix('_ms')}": [ms.get(name, 0.0) for ms in found]
        for name in names
    }


def passes_ms(found: list[dict[str, float]]) -> list[float]:
    """Return the sum of each frame's passes."""
    return [
        sum(ms for name, ms in stages_ms.items() if name not in HOST_STAGES)
        for stages_ms in found
    ]


def array_times(case: Case, pace: Pace, *, is_moving: bool) -> dict[str, Any]:
    """Return the times of frames of arrays by name."""
    found = frames_of(case, pace, is_moving=is_moving)(case.frame)
    wall_ms = [wall_ms for wall_ms, _ in found]
    stages = [stages_ms for _, stages_ms in found]
    return {
        "frame": wall_ms,
        "  passes": passes_ms(stages),
        "  around": np.subtract(wall_ms, passes_ms(stages)),
        **stage_times(stages),
    }


def texture_times(case: TextureCase, pace: Pace, *, is_moving: bool) -> dict[str, Any]:
    """Return the times of frames of textures by name."""
    frames = frames_of(case, pace, is_moving=is_moving)
    case.incomplete_count = 0
    found = frames(case.frame)
    query = case.new_query()
    gpu_ms = frames(lambda state: case.gpu_ms(state, query))
    stages = frames(case.passes_ms)
    if case.incomplete_count:
        told = f"{case.eye}, {case.setting}: {case.incomplete_count} incomplete frames"
        print(told, file=sys.stderr)
    return {
        "frame": [wall_ms for wall_ms, _ in found],
        "  call": [stages_ms["call"] for _, stages_ms in found],
        "  gpu": gpu_ms,
        "  passes": passes_ms(stages),
        **stage_times(stages),
    }


def case_rows(gpu: Gpu, case: Case, pace: Pace) -> Iterator[Row]:
    """Yield the rows of an eye and a view: of textures, then of arrays."""
    rates = rates_of(gpu.info["renderer"])
    with gpu.entered():  # a caller's context that is current
        textures = TextureCase(case)
        for is_moving in (False, True):
            times_ms = texture_times(textures, pace, is_moving=is_moving)
            yield from rows_of(textures, times_ms, rates, is_moving=is_moving)
        textures.release()
    for is_moving in (True, False):
        times_ms = array_times(case, pace, is_moving=is_moving)
        yield from rows_of(case, times_ms, rates, is_moving=is_moving)


def counted_frame(gpu: Gpu, eye: str, size_px: tuple[int, int]) -> FrameWork:
    """Return the work of a view; the splat, from which no pass reads, is left out."""
    renderer = FilterRenderer(gpu)
    view, store = view_and_store(eye, size_px)
    handle = renderer.load(store)
    with patch.object(ListPasses, "_splat", lambda *_, **__: None):
        renderer.render(view, handle, output="srgb8", **STATE)
        work = counted_work(renderer, view, handle)
    handle.release()
    return work


def forecast_rows(works: dict[tuple[str, str], FrameWork], results: dict) -> list[Row]:
    """Return a row for each pass that ``results`` measured, by eye and view.

    Parameters
    ----------
    works : dict
        Work of all views of a frame by eye and setting, of at least two eyes.
    results : dict
        Content of gpu.json.
    """
    measured_ms = {
        (row["case"], row["setting"], row["method"].strip()): row["median_ms"]
        for row in results["rows"]
    }
    bounds_ms = {
        (eye, f"{setting} frozen", stage): done.bound_ms(RATES["H200"])
        for (eye, setting), work in works.items()
        for stage, done in work.passes().items()
        if stage not in STATE_STAGES
    }
    rows = []
    for key, bound_ms in bounds_ms.items():
        eye, setting, stage = key
        others = [
            other_ms / measured_ms[other]
            for other, other_ms in bounds_ms.items()
            if other[0] != eye and other[2] == stage and other in measured_ms
        ]
        if key not in measured_ms or not others:
            continue
        forecast_ms = bound_ms / float(np.mean(others))
        error = forecast_ms / measured_ms[key] - 1.0
        rows.append(
            Row(
                *("gpu", f"forecast {stage}", eye, setting, len(others)),
                *(forecast_ms, forecast_ms, memory_mb(), "relative", error),
                "gpu.json, NVIDIA H200",
            )
        )
    return rows


def options(parser: ArgumentParser) -> None:
    """Add the choice of views, and the forecast."""
    parser.add_argument("--views", nargs="+", choices=VIEWS, default=list(VIEWS))
    parser.add_argument(
        "--forecast", action="store_true", help="forecast passes from their work"
    )


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and the clocks of the GPU after each case."""
    gpu = Gpu()
    names = run.options.views
    if run.options.forecast:
        works = {
            (eye, name): counted_frame(gpu, eye, VIEWS[name][0]).times(VIEWS[name][1])
            for name in (names[:1] if run.is_quick else names)
            for eye in EYES
        }
        measured = json.loads((RESULTS / "gpu.json").read_text(encoding="utf-8"))
        return forecast_rows(works, measured), {}
    if gpu.is_software and not run.is_quick:
        sys.exit("bench gpu: no hardware GPU; allowed: --quick, --forecast")
    views = QUICK_VIEWS if run.is_quick else {name: VIEWS[name] for name in names}
    rows: list[Row] = []
    clocks: list[dict] = []
    kept = KeptRows("gpu")
    for setting, (size_px, view_count) in views.items():
        for eye in EYES:
            case = open_case(gpu, eye, setting, size_px, view_count)
            for row in case_rows(gpu, case, QUICK_PACE if run.is_quick else PACE):
                rows.append(row)
                kept.add(row)
            clocks.append(
                {
                    "gl_renderer": gpu.info["renderer"],
                    "case": f"{setting} {eye}",
                    "clocks": nvidia_smi("clocks.sm,clocks.mem"),
                }
            )
            case.release()
    return rows, {"clocks": clocks}
