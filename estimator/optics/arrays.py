"""Arrays in the form that compiled loops require."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def broadcast_copy(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return values broadcast to ``shape`` as a writable array in C order.

    `numpy.broadcast_to` returns a view that is read-only and may repeat its elements.

    Raises
    ------
    ValueError
        The values do not broadcast to the shape.
    """
    return np.array(np.broadcast_to(values, shape), dtype=np.float64, order="C")
