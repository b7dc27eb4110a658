"""State of each eye kept between frames, so that several can alternate without loss."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.frame_states import FrameStates
from filter_service.rendering.native.arrays import Arrays
from filter_service.rendering.native.frame_record import BlendSizes
from filter_service.rendering.native.kernel_plan import KernelPlan
from filter_service.rendering.native.native_store import NativeStore

MAX_KEPT = 4
"""Largest number of eyes: those of a stereo frame, and of clients that stream at the
same time."""


@dataclass(eq=False)
class EyeState:
    """State of an eye's last frame that the next frame in the same state reuses.

    Attributes
    ----------
    handle : NativeStore
    states : FrameStates
    arrays : Arrays
        Arrays of blended kernels.
    plan : KernelPlan or None
    blended : (plan, computed levels, sizes) or None
    """

    handle: NativeStore
    states: FrameStates = field(default_factory=FrameStates)
    arrays: Arrays = field(default_factory=Arrays)
    plan: KernelPlan | None = None
    blended: tuple[KernelPlan, NDArray[np.uint8], BlendSizes] | None = None


class EyeStates:
    """States of the most recently used eyes; those of released stores are dropped."""

    def __init__(self) -> None:
        self._kept: list[EyeState] = []

    def of(self, handle: NativeStore) -> EyeState:
        """Return the state of an eye, and mark it as most recently used."""
        found = next((kept for kept in self._kept if kept.handle is handle), None)
        others = [
            kept
            for kept in self._kept
            if kept is not found and not kept.handle.is_released
        ]
        found = found or EyeState(handle)
        self._kept = [*others[1 - MAX_KEPT :], found]
        return found

    @property
    def memory_mb(self) -> float:
        """Memory of all blended kernels, MB."""
        return sum(kept.arrays.memory_mb for kept in self._kept)
