"""What the passes will take on a GPU that none was at hand for: a forecast from counts.

    python -m tests.benchmarks.gpu_forecast [--json]

gpu.json has the passes of frames of eyes whose blur is the same in all directions, as
they were when a GPU was last at hand.  Their work is counted here (pixels, entries of
the lists, texels of kernels; both engines count alike), and each pass's time, times the
clock that stands with its frame, is laid over it: so much a pixel and an entry, or a
texel.  Frames of traced eyes, those that a stream has, are counted too, and told by the
same prices.  "off" is how far the prices are from the frames that they were found by,
the largest: what a forecast is worth.

Frames of 1280x720 are not among those: the card lowered its clock within them.
Kernels of a changed state are 1.2 times those that are used (shaders/README.md).

Writes results/gpu_forecast.json.
"""

import argparse
import json
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from estimator.profiles.parse import parse_profile
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.bench_gpu import (
    EYES,
    FOCUS_DPT,
    PUPIL_MM,
    VIEWS,
    view_and_spec,
)
from tests.benchmarks.harness import RESULTS, commit_id, machine_info, write_report

CLOCK_MHZ = 1980.0
"""The card's own, at which forecasts are told."""
FORESEEN_RATIO = 1.2
"""Kernels made for a state that is told ahead over those that it uses."""
PRICED_BY = {
    "fragments": ("pixels",),
    "merge": ("pixels",),
    "bin": ("pixels", "entries"),
    "sort": ("pixels", "entries"),
    "splat": ("pixels", "entries"),
    "encode": ("pixels",),
    "psf_blend": ("texels",),
}
"""By stage, what its time grows with."""
LEARNT_FROM = ("2560x1440", "2 x 1832x1920")


@dataclass(frozen=True)
class Work:
    """What the passes of a frame have to do, all its views together."""

    pixels: float
    entries: float
    texels: float

    def of(self, names: tuple[str, ...]) -> list[float]:
        """Return counts by name."""
        return [getattr(self, name) for name in names]


def counted_work(eye: str, setting: str, *, is_now: bool) -> Work:
    """Count the work of a frame of `bench_gpu`, as it is now or as it was measured."""
    size_px, view_count = VIEWS[setting]
    view, spec = view_and_spec(size_px)
    profile = parse_profile(EYES[eye])
    store = build_psf_store(eye_for_spec(profile, spec)[0] if is_now else profile, spec)
    renderer = NativeRenderer()
    seen = renderer.render(
        view,
        renderer.load(store),
        pupil_diameter_mm=PUPIL_MM,
        focus_dpt=FOCUS_DPT,
    )
    renderer.close()
    return Work(
        view_count * size_px[0] * size_px[1],
        view_count * seen.entry_count,
        # the measured frames asked the GPU which kernels they use
        view_count * seen.kernel_texel_count * (FORESEEN_RATIO if is_now else 1.0),
    )


def measured_ms(rows: list[dict], eye: str, setting: str, stage: str) -> float:
    """Time of a stage in gpu.json: of frames that stay, or of a change where it is."""
    how = "moving" if stage == "psf_blend" else "frozen"
    for row in rows:
        if (row["case"], row["setting"]) == (eye, f"{setting} {how}"):
            if row["method"].strip() == stage:
                return row["median_ms"]
    raise KeyError((eye, setting, stage))


def prices(stage: str, rows: list[dict], works: dict) -> tuple[np.ndarray, float]:
    """Return ms a unit of work at the card's clock, and how far off they may be."""
    cases = [case for case in works if case[1] in LEARNT_FROM]
    times_ms = np.array([measured_ms(rows, *case, stage) for case in cases])
    counts = np.array([works[case].of(PRICED_BY[stage]) for case in cases])
    # each frame counts by how many times, not by how many ms, it is off
    price_ms, _ = nnls(counts / times_ms[:, None], np.ones(len(cases)))
    return price_ms, float(np.abs(counts @ price_ms / times_ms - 1.0).max())


def forecast() -> list[dict]:
    """Return a row for each stage, eye and view."""
    measured = json.loads((RESULTS / "gpu.json").read_text(encoding="utf-8"))
    cases = [(eye, setting) for setting in VIEWS for eye in EYES]
    then = {case: counted_work(*case, is_now=False) for case in cases}
    now = {case: counted_work(*case, is_now=True) for case in cases}
    rows = []
    for stage, names in PRICED_BY.items():
        price_ms, off = prices(stage, measured["rows"], then)
        for case in cases:
            counts = now[case].of(names)
            rows.append(
                {
                    "stage": stage,
                    "eye": case[0],
                    "setting": case[1],
                    "forecast_ms": float(np.dot(counts, price_ms)),
                    "off_ratio": off,
                    "ns_each": {
                        name: 1e6 * float(price)
                        for name, price in zip(names, price_ms, strict=True)
                    },
                    "work_measured": dict(
                        zip(names, then[case].of(names), strict=True)
                    ),
                    "work_now": dict(zip(names, counts, strict=True)),
                    "measured_ms": measured_ms(measured["rows"], *case, stage),
                }
            )
    return rows


def table(rows: list[dict]) -> str:
    """Return the forecast as text: a line for each eye and view."""
    stages = list(PRICED_BY)
    lines = [
        "ms at 1980 MHz".ljust(28) + "".join(s.rjust(11) for s in stages) + "  sum"
    ]
    cases = dict.fromkeys((row["eye"], row["setting"]) for row in rows)
    for eye, setting in cases:
        of = {r["stage"]: r for r in rows if (r["eye"], r["setting"]) == (eye, setting)}
        times = "".join(f"{of[s]['forecast_ms']:11.3f}" for s in stages)
        steady = sum(of[s]["forecast_ms"] for s in stages if s != "psf_blend")
        lines.append(f"{setting} {eye}".ljust(28) + times + f"  {steady:.2f} steady")
    offs = {row["stage"]: row["off_ratio"] for row in rows}
    lines.append(
        "off by at most".ljust(28) + "".join(f"{offs[s]:11.0%}" for s in stages)
    )
    return "\n".join(lines)


def main() -> None:
    """Count, tell, and write results/gpu_forecast.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    rows = forecast()
    content = {"machine": machine_info(), "commit": commit_id(), "rows": rows}
    write_report("gpu_forecast", content)
    print(json.dumps(content) if options.json else table(rows))


if __name__ == "__main__":
    main()
