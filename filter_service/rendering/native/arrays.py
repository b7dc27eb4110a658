"""Buffers reused by frames."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

SPARE_RATIO = 1.25
"""Over-allocation for a next frame that needs a little more."""


class Arrays:
    """Arrays by name; each grows when a frame needs more than the previous ones."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def get(self, name: str, count: int, dtype: DTypeLike) -> NDArray[Any]:
        """Return a named array of at least ``count`` elements, contents unchanged."""
        held = self._arrays.get(name)
        if held is None or held.size < count:
            self._arrays.pop(name, None)  # before the new one is allocated
            held = self._arrays[name] = np.empty(int(SPARE_RATIO * count) + 1, dtype)
        return held

    def address(self, name: str, count: int, dtype: DTypeLike) -> int:
        """Return the address of a named array."""
        return int(self.get(name, count, dtype).ctypes.data)

    @property
    def memory_mb(self) -> float:
        """Memory of all arrays, MB."""
        return sum(array.nbytes for array in self._arrays.values()) / 1e6
