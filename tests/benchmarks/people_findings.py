"""Results of comparisons between modeled eyes and measurements of people."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.harness import Row
from tests.benchmarks.rows import row_of

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

    @classmethod
    def of(
        cls,
        measure: str,
        eyes: str,
        setting: str,
        values: NDArray[np.float64],
        theirs: float,
        unit: str,
        source: str,
        **more,
    ) -> "Finding":
        """Return the mean of modeled eyes (n,), with their number and `BAND`."""
        more = {"count": len(values), "band": band_of(values)} | more
        ours = float(np.mean(values))
        return cls(measure, eyes, setting, ours, float(theirs), unit, source, **more)

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
                yield row_of(
                    *("people", self.measure, self.eyes),
                    f"{self.setting}{suffix}: {value:.3f}{limits}",
                    *([self.time_ms], self.unit, value - self.theirs, self.source),
                    n=self.count,
                )


def band_of(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return `BAND` of values (n,); NaN for a single value."""
    if len(values) < 2:
        return math.nan, math.nan
    low, high = np.nanpercentile(values, BAND).tolist()
    return low, high
