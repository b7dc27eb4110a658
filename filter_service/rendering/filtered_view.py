"""Result of a filtered view, for all engines."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.note import Note
from filter_service.view_state import State, WithState


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """Counters of a frame that users receive.

    A new counter needs a field here, with the default 0, and a value from each engine.
    If `Result` has a field of the same name, the service sends the counter.

    Attributes
    ----------
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was missing and filled in, whose distance was outside the
        prepared range, and whose color was not finite and became black.  The last two
        include the hidden layer where it has depth.
    overflow_count : int
        Entries that did not fit a fragment list.  Their light is missing.
    """

    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    overflow_count: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Return the counts by name."""
        return summed_counts([self])


def summed_counts(counts: Sequence[FrameCounts]) -> dict[str, int]:
    """Return the sums of counts by name."""
    names = [count.name for count in fields(FrameCounts)]
    return {name: sum(int(getattr(c, name)) for c in counts) for name in names}


@dataclass(frozen=True, kw_only=True)
class FilteredView(FrameCounts, WithState):
    """A filtered view, with the parameters and statistics of its rendering.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        Time by stage; their sum is the time spent in the engine.
    state : State
        After clamping to the prepared ranges.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into fragments, and entries of the bins' fragment
        lists.  Rows shared by two strips of a very large frame count twice.  With a
        hidden layer, the border counts too.
    kernel_count, kernel_texel_count : int
        Kernels of the frame, and texels of all their levels.
    """

    color: NDArray[Any]
    stage_times_ms: dict[str, float]
    state: State
    fragment_count: int
    merged_count: int
    entry_count: int
    kernel_count: int
    kernel_texel_count: int
    layer_count: int
    notes: list[str]


SAMPLE_STRIDE_PX = 16
"""Stride of the check of the depth unit, which takes 25 us."""

FAR_SCENE_M = 100.0
"""If all depth exceeds this, the unit is probably centimeters or millimeters: scenes
without a nearer object are rare."""


def input_notes(
    depth_m: NDArray[np.float32], missing_depth_count: int, bad_color_count: int
) -> list[str]:
    """Return notes on missing depth, an implausible depth unit and invalid color."""
    return sampled_input_notes(
        depth_m[::SAMPLE_STRIDE_PX, ::SAMPLE_STRIDE_PX],
        bad_color_count,
        has_depth=missing_depth_count < depth_m.size,
    )


def sampled_input_notes(
    sampled_m: NDArray[np.float32], bad_color_count: int, *, has_depth: bool
) -> list[str]:
    """Return the same notes, from depth at some pixels."""
    notes: list[str] = []
    if not has_depth:
        notes.append(Note("no_depth", "no pixel has depth; infinity is assumed"))
    known_m = sampled_m[(sampled_m > 0.0) & (sampled_m < np.inf)]
    if known_m.size and known_m.min() >= FAR_SCENE_M:
        text = f"all depth is beyond {FAR_SCENE_M:g} m: is it in meters?"
        notes.append(Note("depth_implausible", text, beyond_m=FAR_SCENE_M))
    if bad_color_count:
        text = f"{bad_color_count} pixels with non-finite color were set to black"
        notes.append(Note("color_not_finite", text, pixel_count=bad_color_count))
    return notes
