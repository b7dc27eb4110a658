"""Buffers that frames reuse."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

SPARE_RATIO = 1.25
"""Over-allocation, so that slowly rising sizes do not reallocate in every frame."""


class Arrays:
    """Named arrays that only grow."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def get(self, name: str, count: int, dtype: DTypeLike) -> NDArray[Any]:
        """Return a named array of at least ``count`` elements, not initialized.

        Its contents are lost when it grows.
        """
        array = self._arrays.get(name)
        if array is None or array.size < count:
            self._arrays.pop(name, None)  # frees it before the next allocation
            array = self._arrays[name] = np.empty(int(SPARE_RATIO * count) + 1, dtype)
        return array

    def address(self, name: str, count: int, dtype: DTypeLike) -> int:
        """Return the address of a named array."""
        return int(self.get(name, count, dtype).ctypes.data)

    @property
    def memory_mb(self) -> float:
        """Memory of all arrays, MB."""
        return sum(array.nbytes for array in self._arrays.values()) / 1e6
