"""Laws behind measured frame times: exponents, and what each pass is bound by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.harness import Row

UNITS = ("pixel", "fragment", "entry", "evaluation", "kernel", "kernel_texel")
"""Work that a pass may be proportional to; `CostRow` counts each."""

NEGLIGIBLE_SHARE = 0.02
"""A pass that takes less of every frame is left out."""


@dataclass(frozen=True)
class CostRow(Row):
    """A frame's time, its passes' times and what there was to do.

    Attributes
    ----------
    sweep : str
        What varies: "radius", "resolution" or "kernels".
    case : str
        Scene, with what else is fixed.
    radius_px : float
        Blur of the farthest point by geometrical optics.
    entry_count : int
        Of the bins' lists; each stands for one to four tiles.
    evaluation_count, lit_count : int
        PSF weights read: for each fragment of a tile one at each of its pixels; and
        those of them within the kernel's box.
    merged_ratio : float
        Of the pixels.
    merging_db : float or None
        PSNR of the merged against the unmerged frame.
    stage_ms : dict
        Median time by pass.
    """

    sweep: str
    radius_px: float
    pixel_count: int
    fragment_count: int
    merged_ratio: float
    entry_count: int
    evaluation_count: int
    lit_count: int
    kernel_count: int
    kernel_texel_count: int
    layer_count: int
    merging_db: float | None
    stage_ms: dict[str, float]


@dataclass(frozen=True)
class Law:
    """Growth of one quantity in one sweep: it goes as x to the ``exponent``.

    Attributes
    ----------
    quantity : str
        "frame", a pass, or "evaluations".
    last_exponent : float
        Between the last two points, where a sum of powers shows its largest.
    """

    sweep: str
    method: str
    case: str
    against: str
    quantity: str
    exponent: float
    last_exponent: float


@dataclass(frozen=True)
class Bound:
    """The unit of work that a pass's time follows most closely.

    Attributes
    ----------
    ns_per_unit : float
        Median over all rows.
    spread_ratio : float
        Largest over smallest of the middle 80 % of rows; 1 is a perfect law.
    """

    stage: str
    unit: str
    ns_per_unit: float
    spread_ratio: float


def exponent(x: NDArray, y: NDArray) -> float:
    """Least-squares slope of log y over log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def laws(rows: list[CostRow]) -> list[Law]:
    """Laws of every sweep, method and case with three points or more."""
    found = []
    keys = dict.fromkeys((row.sweep, row.method, row.case) for row in rows)
    for sweep, method, case in keys:
        own = [r for r in rows if (r.sweep, r.method, r.case) == (sweep, method, case)]
        against = AGAINST[sweep]
        own.sort(key=lambda row: getattr(row, against))
        x = np.array([getattr(row, against) for row in own], float)
        if np.unique(x).size < 3:
            continue
        quantities = {
            "frame": [row.median_ms for row in own],
            "evaluations": [row.evaluation_count for row in own],
            **{
                stage: [row.stage_ms[stage] for row in own]
                for stage in notable_stages(own)
            },
        }
        for quantity, values in quantities.items():
            y = np.array(values, float)
            if y.min() <= 0.0:
                continue
            last = exponent(x[-2:], y[-2:])
            slope = exponent(x, y)
            found.append(Law(sweep, method, case, against, quantity, slope, last))
    return found


AGAINST = {
    "radius": "radius_px",
    "resolution": "pixel_count",
    "kernels": "kernel_count",
}


def notable_stages(rows: list[CostRow]) -> list[str]:
    """Passes that take a share of some frame."""
    names = dict.fromkeys(name for row in rows for name in row.stage_ms)
    return [
        name
        for name in names
        if all(name in row.stage_ms for row in rows)
        and max(row.stage_ms[name] / row.median_ms for row in rows) > NEGLIGIBLE_SHARE
    ]


def bounds(rows: list[CostRow]) -> list[Bound]:
    """For each pass the unit whose price varies least over all rows."""
    found = []
    for stage in notable_stages(rows):
        best = None
        for unit in UNITS:
            ns_per_unit = np.array(
                [
                    1e6 * row.stage_ms[stage] / getattr(row, f"{unit}_count")
                    for row in rows
                ]
            )
            low, middle, high = np.percentile(ns_per_unit, [10, 50, 90])
            if low <= 0.0:
                continue
            bound = Bound(stage, unit, float(middle), float(high / low))
            if best is None or bound.spread_ratio < best.spread_ratio:
                best = bound
        if best is not None:
            found.append(best)
    return found
