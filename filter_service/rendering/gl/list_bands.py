"""Division of a frame's fragment lists into bands of bins that fit a buffer."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    MAX_GROUPS,
    TOTAL_ENTRIES,
    TOTAL_ENTRIES_FLOAT,
    TOTAL_LONGEST,
    TOTAL_LOST,
)

ENTRY_BYTES = 4
MAX_BAND_ENTRIES = 16 * 2**20
"""Largest number of list entries in one band.  A list buffer has at most 64 MB, half of
the smallest storage block that the service supports.  This is also the capacity of
one bin's list.  A bin has fewer than 2**19 pixels within the reach of a kernel, so
entries can only be lost (and counted) if there are many surfaces or a smaller limit."""

MAX_BAND_BINS = MAX_GROUPS
"""Bins in one band: the passes dispatch a row of work groups, one for each bin."""


@dataclass(frozen=True)
class ListTotals:
    """Totals of the prefix sum over the lists.

    Attributes
    ----------
    entry_count : int
        Entries of all lists; exact below 2**32, rounded to seven digits above.
    overflow_count : int
        Entries that did not fit a bin's list.
    longest : int
        Entries of the longest list.
    """

    entry_count: int = 0
    overflow_count: int = 0
    longest: int = 0


def read_totals(whole: NDArray[np.uint32]) -> ListTotals:
    """Return the totals from the words that follow the bins' offsets."""
    as_float = whole[TOTAL_ENTRIES_FLOAT : TOTAL_ENTRIES_FLOAT + 1].view(np.float32)
    rounded = round(float(as_float[0]))
    return ListTotals(
        entry_count=rounded if rounded > 2**31 else int(whole[TOTAL_ENTRIES]),
        overflow_count=int(whole[TOTAL_LOST]),
        longest=int(whole[TOTAL_LONGEST]),
    )


def split(counts: NDArray[np.int64], limit: int) -> tuple[NDArray[np.int64], list[Any]]:
    """Divide lists into bands of at most ``limit`` entries and MAX_BAND_BINS bins.

    Returns
    -------
    offsets : (n_bins,)
        First entry of each list within its band.
    bands : list of (first bin, bin count, entries)
    """
    bands, offsets = [], np.zeros(len(counts), dtype=np.int64)
    first = 0
    while first < len(counts):
        sums = np.cumsum(counts[first : first + MAX_BAND_BINS])
        bins = max(int(np.searchsorted(sums, limit, side="right")), 1)
        offsets[first : first + bins] = sums[:bins] - counts[first : first + bins]
        bands.append((first, bins, int(sums[bins - 1])))
        first += bins
    return offsets, bands
