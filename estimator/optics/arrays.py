"""Arrays in the form that compiled loops require."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def broadcast_copy(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return values broadcast to ``shape`` as a writable array in C order.

    `numpy.broadcast_to` returns a read-only view, which `numpy.ascontiguousarray` does
    not copy if it is contiguous.  To numba, read-only arrays are another type, for
    which it recompiles everything: 7 s for the ray tracer.

    Raises
    ------
    ValueError
        The values do not broadcast to the shape.
    """
    return np.array(np.broadcast_to(values, shape), dtype=np.float64, order="C")
