"""Arrays in the one form that compiled loops are compiled for."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def broadcast_copy(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return values, which broadcast to ``shape``, spread over it: C order, writable.

    `numpy.broadcast_to` gives a read-only view, and of an array that has the shape
    already `numpy.ascontiguousarray` keeps it so: another type, for which numba
    compiles everything once more, some 7 s for the ray tracer.

    Raises
    ------
    ValueError
        The values do not broadcast to the shape.
    """
    return np.array(np.broadcast_to(values, shape), dtype=np.float64, order="C")
