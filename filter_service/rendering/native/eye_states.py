"""Cached state of the most recently used eyes, so that several eyes can alternate."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.native.arrays import Arrays
from filter_service.rendering.native.frame_record import BlendSizes
from filter_service.rendering.native.kernel_plan import KernelPlan
from filter_service.rendering.native.native_store import NativeStore

MAX_EYES = 4
"""Cache size: the eyes of a stereo frame, and those of clients that stream at the same
time."""


@dataclass(eq=False)
class EyeState:
    """Results of an eye's last frame that the next frame can reuse.

    Attributes
    ----------
    handle : NativeStore
    arrays : Arrays
        Arrays of blended kernels.
    plan : KernelPlan or None
    blended : (plan, computed levels, sizes) or None
    """

    handle: NativeStore
    arrays: Arrays = field(default_factory=Arrays)
    plan: KernelPlan | None = None
    blended: tuple[KernelPlan, NDArray[np.uint8], BlendSizes] | None = None


class EyeStates:
    """Cache of the most recently used eyes; released stores are dropped."""

    def __init__(self) -> None:
        self._eyes: list[EyeState] = []

    def of(self, handle: NativeStore) -> EyeState:
        """Return the state of an eye, which becomes the most recently used."""
        found = next((eye for eye in self._eyes if eye.handle is handle), None)
        others = [
            eye for eye in self._eyes if eye is not found and not eye.handle.is_released
        ]
        found = found or EyeState(handle)
        self._eyes = [*others[1 - MAX_EYES :], found]
        return found

    @property
    def memory_mb(self) -> float:
        """Memory of all blended kernels, MB."""
        return sum(eye.arrays.memory_mb for eye in self._eyes)
