"""Results of comparisons between modeled eyes and measurements of people."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.harness import Row, memory_mb

BAND = (10.0, 90.0)
"""Percentiles of people that bands show."""


@dataclass(frozen=True)
class Finding:
    """A value of modeled eyes, with the published value for people.

    Attributes
    ----------
    measure, eyes, setting : str
        Measured quantity, group of modeled eyes, and conditions.
    ours, theirs : float
    unit : str
    source : str
        The study.
    count : int
        Number of modeled eyes.
    time_ms : float
        Computation time per eye.
    with_residual, with_halo : float
        Value of the modeled eyes with the residual refraction of the subjects, and in
        addition with the light that scatters in a double pass; NaN if the study has
        none.
    band : (float, float)
        `BAND` of the modeled eyes; NaN for a single eye.
    interval : (float, float)
        95 % interval of a sample of people; NaN if there is none.
    """

    measure: str
    eyes: str
    setting: str
    ours: float
    theirs: float
    unit: str
    source: str
    count: int = 1
    time_ms: float = 0.0
    with_residual: float = math.nan
    with_halo: float = math.nan
    band: tuple[float, float] = (math.nan, math.nan)
    interval: tuple[float, float] = (math.nan, math.nan)

    @property
    def difference(self) -> float:
        """Return the value of modeled eyes minus the published one."""
        return self.ours - self.theirs

    @property
    def is_inside(self) -> bool:
        """Whether the value of modeled eyes is within the interval."""
        low, high = self.interval
        return low <= self.ours <= high

    def rows(self) -> Iterator[Row]:
        """Yield a row of the value, and rows with the effects of the instrument."""
        values = {
            "": self.ours,
            ", residual refraction": self.with_residual,
            ", residual refraction and halo": self.with_halo,
        }
        low, high = self.interval
        limits = f" ({low:.3f} to {high:.3f})" if math.isfinite(low) else ""
        for suffix, value in values.items():
            if math.isfinite(value):
                yield Row(
                    *("people", self.measure, self.eyes),
                    f"{self.setting}{suffix}: {value:.3f}{limits}",
                    *(self.count, self.time_ms, self.time_ms, memory_mb()),
                    *(self.unit, value - self.theirs, self.source),
                )


def band_of(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return `BAND` of values (n,); NaN for a single value."""
    if len(values) < 2:
        return math.nan, math.nan
    low, high = np.nanpercentile(values, BAND).tolist()
    return low, high


def print_findings(findings: Iterable[Finding]) -> None:
    """Print modeled and published values, and the effects of the instrument."""
    print(
        f"\n{'measure':<25}{'eyes':<25}{'setting':<32}{'ours':>8}{'theirs':>8}"
        f"{'diff':>8}{'residu':>8}{'halo':>8}{'left':>8}  {'range':<16}source"
    )
    for found in findings:
        left = (
            found.with_halo if math.isfinite(found.with_halo) else found.with_residual
        )
        cells = (
            *(found.ours, found.theirs, found.difference),
            *(found.with_residual - found.ours, found.with_halo - found.with_residual),
            left - found.theirs,
        )
        texts = [f"{c:8.3f}" if math.isfinite(c) else f"{'-':>8}" for c in cells]
        low, high = found.band if math.isnan(found.interval[0]) else found.interval
        band = f"{low:.3f} {high:.3f}" if math.isfinite(low) else "-"
        print(
            f"{found.measure:<25}{found.eyes:<25}{found.setting:<32}"
            f"{''.join(texts)}  {band:<16}{found.source}"
        )
