"""GPU times of frames, forecast from counted work where no GPU is at hand.

    python -m tests.benchmarks.gpu_forecast [--json] [--counted]

gpu.json has the passes of frames as they were when a GPU was last at hand.  Their work
is counted here (`pass_work`; engines count alike), and each pass's times are fitted by
prices of its counts, such as so much per pixel and evaluation, that none is negative
and that the relative errors are smallest.  Passes that gpu.json lacks have the price
of a similar one, or their bound and the time of empty dispatches.

- Passes are fitted to frames whose state stays.  Blending is of changed states; there
  the card had lowered its clock in frames of one view, so that its times are multiplied
  by the ratio of the splat's times, whose work is the same.  Those frames blended 1.2
  times the kernels that they used (FORESEEN_RATIO).
- Around the passes of arrays: the time of gpu.json for a state that stays, so much per
  view and pixel; a change adds what it adds to the processor's time in host.json.
- Frames of textures: the passes plus the processor's time to submit them (host.json,
  on its processor).  Where the GPU works meanwhile, a frame takes less, at least the
  longer of the two (``low_ms``).

``off``: each eye's times by the prices of the other two eyes, the largest deviation.

Prints the forecast beside the goals of the GPU kit.  Writes results/gpu_forecast.json.
"""

import argparse
import json
from dataclasses import asdict
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.renderer import FilterRenderer
from tests.benchmarks.gpu_cases import EYES, STATE, VIEWS, view_and_store
from tests.benchmarks.harness import RESULTS, commit_id, machine_info, write_report
from tests.benchmarks.pass_work import RATES, FrameWork, counted_work
from tests.gpu_kit.goals import Goal, read_goals

FORESEEN_RATIO = 1.2
"""Kernels blended for a state that was told ahead over those that it used."""
PRICED_BY = {
    "fragments": ("pixels", "views"),
    "merge": ("pixels", "views"),
    "bin": ("searched", "tests", "views"),
    "sort": ("sorted_entries", "entries", "views"),
    "splat": ("pixels", "evaluations", "views"),
    "encode": ("pixels", "views"),
    "psf_blend": ("node_texels", "texels", "views"),
    "around": ("views", "pixels"),
}
"""By stage, what its time grows with: counts with which eyes foretell each other."""
PLAN_DISPATCHES, BLEND_DISPATCHES = 4, 5

Case = tuple[str, str]
"""Eye and setting."""


def works() -> dict[Case, FrameWork]:
    """Count the work of the frames of `bench_gpu`; the splat itself is left out."""
    gpu = Gpu()
    renderer = FilterRenderer(gpu)
    found = {}
    with patch.object(ListPasses, "_splat", lambda *_, **__: None):
        for setting, (size_px, view_count) in VIEWS.items():
            for eye in EYES:
                view, store = view_and_store(eye, size_px)
                handle = renderer.load(store)
                renderer.render(view, handle, output="srgb8", **STATE)
                work = counted_work(renderer, view, handle)
                found[eye, setting] = work.times(view_count)
                handle.release()
    gpu.close()
    return found


def last_works() -> dict[Case, FrameWork]:
    """Return the work that results/gpu_forecast.json has."""
    content = json.loads((RESULTS / "gpu_forecast.json").read_text(encoding="utf-8"))
    return {
        (work.pop("case"), work.pop("setting")): FrameWork(**work)
        for work in content["works"]
    }


class Measured:
    """Times of gpu.json and host.json, ms."""

    def __init__(self) -> None:
        self._gpu, self._host = (
            json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))["rows"]
            for name in ("gpu", "host")
        )

    def _row_ms(self, case: Case, stage: str, how: str) -> float:
        eye, setting = case
        wanted = stage, eye, f"{setting} {how}"
        for row in self._gpu:
            if (row["method"].strip(), row["case"], row["setting"]) == wanted:
                return float(row["median_ms"])
        raise KeyError(wanted)

    def stage_ms(self, case: Case, stage: str) -> float:
        """Time of a stage, at the clock of frames whose state stays."""
        if stage != "psf_blend":
            return self._row_ms(case, stage, "frozen")
        ratio = self._row_ms(case, "splat", "frozen") / self._row_ms(
            case, "splat", "moving"
        )
        return ratio * self._row_ms(case, stage, "moving")

    def host_ms(self, view_count: int, how: str, *, part: str) -> float:
        """Processor's time of a part of a frame: of the eye with less load beside."""
        name = next(n for n, (_, count) in VIEWS.items() if count == view_count)
        start = f"{name} {how}"
        return min(
            float(row["median_ms"])
            for row in self._host
            if row["method"] == part and row["setting"].split(";")[0] == start
        )


def counts_of(stage: str, work: FrameWork) -> list[float]:
    """Return the counts that a stage's time grows with."""
    return work.of(PRICED_BY[stage])


def fitted(stage: str, measured: Measured, works: dict) -> NDArray[np.float64]:
    """Return ms per unit of each count, from the cases of some works."""
    times_ms = np.array([measured.stage_ms(case, stage) for case in works])
    counts = np.array([counts_of(stage, work) for work in works.values()])
    if stage == "psf_blend":
        counts[:, :2] *= FORESEEN_RATIO  # texels
    # each frame counts by how many times, not by how many ms, it is off
    price_ms, _ = nnls(counts / times_ms[:, None], np.ones(len(times_ms)))
    return price_ms


class Forecast:
    """Times by the prices of some eyes.

    Parameters
    ----------
    works : dict
        Work of the cases that the prices are found from.
    """

    def __init__(self, measured: Measured, works: dict[Case, FrameWork]):
        self._measured = measured
        self.prices_ms = {stage: fitted(stage, measured, works) for stage in PRICED_BY}

    def stage_ms(self, stage: str, work: FrameWork) -> float:
        """Time of a stage that gpu.json has."""
        return float(np.dot(counts_of(stage, work), self.prices_ms[stage]))

    def stages_ms(
        self, work: FrameWork, *, is_moving: bool, is_textures: bool
    ) -> dict[str, float]:
        """Return the time of each pass."""
        own = dict(zip(PRICED_BY["encode"], self.prices_ms["encode"], strict=True))
        dispatch_ms = own["views"] * work.views
        plan = work.passes()["kernel_plan"].bound_ms(RATES["H200"])
        stages = ("fragments", "merge", "bin", "sort", "splat")
        found = {stage: self.stage_ms(stage, work) for stage in stages}
        found["kernel_plan"] = PLAN_DISPATCHES * dispatch_ms + is_moving * plan
        found["psf_blend"] = BLEND_DISPATCHES * dispatch_ms
        if is_moving:
            found["psf_blend"] = self.stage_ms("psf_blend", work)
        encode_ms = self.stage_ms("encode", work)
        if not is_textures:
            return found | {"encode": encode_ms}
        passes = work.passes()
        ratio = passes["show"].bytes / passes["encode"].bytes
        return found | {"show": ratio * encode_ms, "sample": dispatch_ms}

    def around_ms(
        self, work: FrameWork, *, is_moving: bool, is_textures: bool
    ) -> float:
        """Time around the passes: of frames of textures the calls."""
        views = round(work.views)
        if is_textures:
            how = "moving" if is_moving else "frozen"
            return self._measured.host_ms(views, f"textures {how}", part="all")
        stays_ms, changes_ms = (
            self._measured.host_ms(views, how, part="rest")
            for how in ("frozen", "moving")
        )
        added_ms = max(changes_ms - stays_ms, 0.0) if is_moving else 0.0
        return self.stage_ms("around", work) + added_ms

    def rows(self, works: dict[Case, FrameWork]) -> list[dict]:
        """Return rows like those of `bench_gpu`: of frames, and of their passes."""
        rows = []
        for (eye, setting), work in works.items():
            for is_textures in (False, True):
                for is_moving in (False, True):
                    how = {"is_moving": is_moving, "is_textures": is_textures}
                    stages_ms = self.stages_ms(work, **how)
                    passes_ms, around_ms = (
                        sum(stages_ms.values()),
                        self.around_ms(work, **how),
                    )
                    of = {
                        "case": eye,
                        "setting": setting
                        + " textures" * is_textures
                        + (" moving" if is_moving else " frozen"),
                    }
                    low_ms = passes_ms + around_ms
                    if is_textures:
                        low_ms = max(passes_ms, around_ms)
                    rows += [
                        {"method": "frame", **of, "median_ms": passes_ms + around_ms}
                        | {"low_ms": low_ms, "around_ms": around_ms},
                        {"method": "passes", **of, "median_ms": passes_ms}
                        | {"stages_ms": stages_ms},
                    ]
        return rows


def off_ratios(measured: Measured, works: dict[Case, FrameWork]) -> dict[str, float]:
    """Deviations of an eye's times by the prices of the others, the largest."""
    found: dict[str, list[float]] = {}
    for eye in EYES:
        others = {case: work for case, work in works.items() if case[0] != eye}
        forecast = Forecast(measured, others)
        for case, work in works.items():
            if case[0] != eye:
                continue
            pairs = {
                stage: (forecast.stage_ms(stage, work), measured.stage_ms(case, stage))
                for stage in PRICED_BY
            }
            stays = [name for name in PRICED_BY if name not in ("psf_blend", "around")]
            pairs["passes"] = tuple(np.sum([pairs[name] for name in stays], axis=0))
            pairs["frame"] = tuple(np.add(pairs["passes"], pairs["around"]))
            for name, (told_ms, true_ms) in pairs.items():
                found.setdefault(name, []).append(abs(told_ms / true_ms - 1.0))
    return {name: max(values) for name, values in found.items()}


def table(rows: list[dict], off: dict[str, float], goals: list[Goal]) -> str:
    """Return the forecast as text: a line for each frame, then the goals."""
    names = ("kernel_plan", *(n for n in PRICED_BY if n != "around"), "show", "sample")
    widths = [max(len(name), 6) + 1 for name in names]
    heads = "".join(f"{n:>{w}}" for n, w in zip(names, widths, strict=True))
    lines = [f"{'ms':42}{heads} passes around  frame"]
    for frame, passes in zip(rows[::2], rows[1::2], strict=True):
        times = "".join(
            f"{passes['stages_ms'].get(n, 0.0):{w}.3f}"
            for n, w in zip(names, widths, strict=True)
        )
        lines.append(
            f"{frame['setting'] + ' ' + frame['case']:42}{times}"
            f"{passes['median_ms']:7.2f}{frame['around_ms']:7.2f}"
            f"{frame['median_ms']:7.2f} ({frame['low_ms']:.2f})"
        )
    lines.append("off: " + ", ".join(f"{n} {ratio:.0%}" for n, ratio in off.items()))
    for goal in goals:
        told_ms = goal.measured({"rows": rows})
        if told_ms is not None:
            lines.append(f"{goal.what}: {told_ms:.2f} ms, goal {goal.wanted}")
    return "\n".join(lines)


def main() -> None:
    """Count, tell, and write results/gpu_forecast.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--counted", action="store_true", help="use the counts of the last run"
    )
    options = parser.parse_args()
    measured, counted = Measured(), last_works() if options.counted else works()
    forecast = Forecast(measured, counted)
    rows, off = forecast.rows(counted), off_ratios(measured, counted)
    content = {
        "machine": machine_info(),
        "commit": commit_id(),
        "rows": rows,
        "off_ratios": off,
        "prices_ns": {
            stage: dict(zip(PRICED_BY[stage], (1e6 * price_ms).tolist(), strict=True))
            for stage, price_ms in forecast.prices_ms.items()
        },
        "works": [
            {"case": eye, "setting": setting} | asdict(work)
            for (eye, setting), work in counted.items()
        ],
    }
    write_report("gpu_forecast", content)
    print(json.dumps(content) if options.json else table(rows, off, read_goals()))


if __name__ == "__main__":
    main()
