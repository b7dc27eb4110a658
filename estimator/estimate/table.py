"""Small table of start eyes for fits; one of them is near any measured eye.

`training.first_guess_table` regenerates ``eye_table.json``.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.eye.parameters import PARAMETER_NAMES, mean_vector

TABLE_FILE = Path(__file__).parent / "eye_table.json"


@cache
def table_vectors() -> NDArray[np.float64]:
    """Return the vectors (P, 45) of the table; the first is the mean eye."""
    rows = json.loads(TABLE_FILE.read_text(encoding="utf-8"))["eyes"]
    vectors: list[list[float]] | NDArray[np.float64]
    vectors = [[row[name] for name in PARAMETER_NAMES] for row in rows]
    vectors = np.array([mean_vector().tolist(), *vectors])
    vectors.setflags(write=False)
    return vectors
