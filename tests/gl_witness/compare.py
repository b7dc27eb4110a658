"""How far what two processes filtered lies apart, in numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.gl_witness.filter_frames import COUNTS, Filtered
from tests.numerical.synthetic import psnr_db


@dataclass(frozen=True)
class Difference:
    """A frame, and the same of another process.

    Attributes
    ----------
    psnr_db, largest : float
        In linear light with peak 1, of encoded pictures in their steps over 255.
    counts : dict
        Counts that differ: (here, there).
    """

    name: str
    psnr_db: float
    largest: float
    counts: dict[str, tuple[int, int]]

    @property
    def is_none(self) -> bool:
        """Whether every byte and count is the same."""
        return self.largest == 0.0 and not self.counts


def differences(here: Filtered, there: Filtered) -> list[Difference]:
    """Frame by frame."""
    if here.stores != there.stores or here.arrays.keys() != there.arrays.keys():
        raise ValueError("the two have filtered different things")
    return [_difference(name, here, there) for name in here.arrays]


def _difference(name: str, here: Filtered, there: Filtered) -> Difference:
    a, b = (_as_light(side.arrays[name]) for side in (here, there))
    ours, theirs = here.counts.get(name, {}), there.counts.get(name, {})
    return Difference(
        name,
        psnr_db=round(psnr_db(a, b), 1),
        largest=float(np.abs(a - b).max()),
        counts={c: (ours[c], theirs[c]) for c in ours if ours[c] != theirs[c]},
    )


def _as_light(picture: NDArray) -> NDArray[np.float64]:
    scale = 255.0 if picture.dtype == np.uint8 else 1.0
    return picture.astype(np.float64) / scale


def summary(group: list[Difference]) -> dict:
    """Worst of many."""
    return {
        "compared": len(group),
        "byte for byte": sum(difference.is_none for difference in group),
        "least_psnr_db": min(difference.psnr_db for difference in group),
        "largest": max(difference.largest for difference in group),
        "least_alike": min(group, key=lambda difference: difference.psnr_db).name,
        **{
            f"other {name}": sum(name in difference.counts for difference in group)
            for name in COUNTS
            if any(name in difference.counts for difference in group)
        },
    }
