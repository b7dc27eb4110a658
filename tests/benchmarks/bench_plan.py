"""Plans of PSF caches: predicted and measured size, time and error.

    python -m tests.benchmarks.bench_plan [--quick] [--json] [--calibrate]

Interpolation: PSNR of images of *Courtyard*'s spectrum, filtered with PSFs as a frame
reads them from the plan against exactly computed ones, at random states of frames
(`sample_states`: half of the objects in focus).  Memory and time: a cache really built,
or for large ones a random part of its PSFs.  The paper's grids also at their nodes,
where only storage errs, and half-way between nodes of all axes at once.
"""

import argparse
import json
import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from estimator.psf.survey import survey_pupils
from filter_service.planning.cost import cost_terms, plan_states
from filter_service.planning.node_wavefronts import state_frames
from filter_service.planning.nodes import CachePlan
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.pack import pack_kernels
from tests.benchmarks.harness import (
    Row,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.plan_frames import frame_rows
from tests.numerical.plan_cases import (
    exact_kernels,
    halfway_errors,
    mean_db,
    node_errors,
    sampled_errors,
    spec_for,
    traced_eye,
)

EYES = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
PAPER_GB = {  # Table 9: texture of quality, cache of dynamic
    "emmetropia": (1.54, 5.71),
    "myopia": (1.13, 4.70),
    "astigmatism": (1.13, 4.43),
    "keratoconus": (2.14, 7.68),
    "cataract": (0.46, 3.09),
    "post_lasik": (2.32, 6.50),
}
STILL = {"pupil_range_mm": (5.0, 5.0), "focus_range_dpt": (0.0, 0.0)}
PAPER_STILL = {
    "pupil_range_mm": (5.0, 5.0),
    "focus_range_dpt": (0.125, 0.125),
    "object_range_dpt": (0.125, 8.125),
}
PAPER_MOVING = {
    "pupil_range_mm": (2.0, 6.0),
    "focus_range_dpt": (0.125, 4.125),
    "object_range_dpt": (0.125, 8.125),
}
HD = {"width_px": 1280, "height_px": 720}
PART = 768


@dataclass(frozen=True)
class Built:
    """A random part of a cache's PSFs, scaled to all of them."""

    memory_mb: float
    build_s: float


def build_part(eye, spec, plan: CachePlan, count: int) -> Built:
    """Compute and pack PSFs of a plan; processor time over the cores it would use."""
    states = plan_states(spec, plan, count)
    total = plan.prediction.psf_count
    size, spent_s, done = 0, 0.0, 0
    for first in range(0, states.h_deg.size, PART):
        part = states.select(slice(first, first + PART))
        start_s = time.process_time()
        batch = exact_kernels(eye, spec, part)
        packed = pack_kernels(batch, kept_energy_ratio=spec.kept_energy_ratio)
        spent_s += time.process_time() - start_s
        size += packed.weights.nbytes
        done += len(batch)
    return Built(
        memory_mb=size * total / done / 1e6,
        build_s=spent_s * total / done / plan.prediction.core_count,
    )


def rows_of(name, spec, setting, *, n_states, n_psfs, case_errors=None) -> list[Row]:
    """Predicted and measured row of one plan."""
    eye = traced_eye(name, spec)
    plan = unchecked_plan(eye, spec)
    built = build_part(eye, spec, plan, n_psfs)
    errors = sampled_errors(eye, spec, plan, count=n_states)
    predicted = plan.prediction
    common = {
        "bench": "plan",
        "case": name,
        "setting": setting,
        "n": predicted.psf_count,
        "error_name": "psnr_db",
        "reference": f"exact PSFs at {n_states} random states; grid h x v x pupil x "
        f"accommodation {_shape(plan)}",
    }
    rows = [
        Row(
            method="predicted",
            median_ms=1e3 * predicted.build_s,
            p95_ms=1e3 * predicted.build_s,
            memory_mb=predicted.memory_mb,
            error=predicted.interpolation_db,
            **common,
        ),
        Row(
            method="measured",
            median_ms=1e3 * built.build_s,
            p95_ms=1e3 * built.build_s,
            memory_mb=built.memory_mb,
            error=mean_db(errors),
            **common,
        ),
    ]
    for method, function in (case_errors or {}).items():
        rows.append(
            Row(
                method=method,
                median_ms=1e3 * built.build_s,
                p95_ms=1e3 * built.build_s,
                memory_mb=built.memory_mb,
                error=mean_db(function(eye, spec, plan, count=n_states)),
                **common | {"reference": "exact PSFs at these states"},
            )
        )
    return rows


def _shape(plan: CachePlan) -> str:
    n_pupils, n_used, n_v, n_h = plan.group_shape
    return f"{n_h} x {n_v} x {n_pupils} x {n_used}"


def planned_rows(eyes, sizes, n_states, n_psfs) -> list[Row]:
    """Rows over eyes, sizes, modes and tolerances."""
    rows = []
    for name in eyes:
        for size in sizes:
            for mode, still in (("dynamic", {}), ("quality", STILL)):
                for tolerance in ("loose", "normal", "fine"):
                    spec = spec_for(mode=mode, tolerance=tolerance, **size, **still)
                    setting = f"{mode} {tolerance} {spec.camera.width_px} px"
                    rows += rows_of(
                        name, spec, setting, n_states=n_states, n_psfs=n_psfs
                    )
    return rows


def paper_rows(eyes, n_states, n_psfs) -> list[Row]:
    """The paper's grids at 1280 x 720 beside its Table 9."""
    rows = []
    for name in eyes:
        for mode, ranges, paper_gb in (
            ("quality", PAPER_STILL, PAPER_GB[name][0]),
            ("dynamic", PAPER_MOVING, PAPER_GB[name][1]),
        ):
            spec = spec_for(mode=mode, grid="paper", **HD, **ranges)
            rows += rows_of(
                name,
                spec,
                f"paper {mode}, theirs {paper_gb:g} GB",
                n_states=n_states,
                n_psfs=n_psfs,
                case_errors={"at nodes": node_errors, "half-way": halfway_errors},
            )
    return rows


def calibrate(n_psfs: int) -> dict[str, float]:
    """Fit the cost model's constants to processor time over very different batches."""
    terms, spent_us, counts = [], [], []
    for name in ("emmetropia", "keratoconus", "astigmatism"):
        for width_px in (480, 1280, 2000):
            spec = spec_for(width_px, width_px * 9 // 16, mode="dynamic")
            eye = traced_eye(name, spec)
            states = plan_states(spec, unchecked_plan(eye, spec), n_psfs)
            order = np.argsort(states.pupil_diameter_mm, kind="stable")
            for rows in np.array_split(order, max(2, n_psfs // PART)):
                part = states.select(rows)
                times_us = []
                for _ in range(3):
                    start_s = time.process_time()
                    batch = exact_kernels(eye, spec, part)
                    pack_kernels(batch, kept_energy_ratio=spec.kept_energy_ratio)
                    times_us.append(1e6 * (time.process_time() - start_s))
                survey = survey_pupils(state_frames(eye, spec, part))
                found = cost_terms(spec, survey)
                terms.append([values.sum() for values in found.values()])
                spent_us.append(min(times_us))
                counts.append(rows.size)
    terms, spent_us = np.array(terms), np.array(spent_us)
    constants, _ = nnls(terms / spent_us[:, None], np.ones(len(spent_us)))
    ratio = terms @ constants / spent_us
    return {
        **dict(zip(found, (float(f"{c:.3g}") for c in constants), strict=True)),
        "batches": len(spent_us),
        "us_per_psf": [
            float(x) for x in np.percentile(spent_us / len(rows), (0, 50, 100))
        ],
        "predicted_over_measured": [
            float(x) for x in np.percentile(ratio, (0, 50, 100))
        ],
    }


def main(argv=None) -> int:
    """Print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--calibrate", action="store_true")
    options = parser.parse_args(argv)
    if options.calibrate:
        print(json.dumps(calibrate(4 * PART), indent=1))
        return 0
    eyes = EYES[:1] if options.quick else EYES
    n_states, n_psfs = (48, PART) if options.quick else (96, 2 * PART)
    sizes = ({},) if options.quick else ({}, HD)
    rows = planned_rows(eyes, sizes, n_states, n_psfs)
    rows += paper_rows(eyes, n_states, n_psfs)
    rows += frame_rows(eyes[:1] if options.quick else ("emmetropia", "keratoconus"))
    content = report(rows)
    if options.json:
        print(json.dumps(content))
        return 0
    print_rows(rows)
    if not options.quick:
        print(write_report("plan", content))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
