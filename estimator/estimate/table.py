"""A small table of eyes, one of which is near any measured one: where fits start.

`make_table` makes ``eye_table.json`` anew.
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
    """Vectors (P, 45) of the table; the mean eye is the first."""
    rows = json.loads(TABLE_FILE.read_text(encoding="utf-8"))["eyes"]
    vectors = [[row[name] for name in PARAMETER_NAMES] for row in rows]
    vectors = np.array([mean_vector().tolist(), *vectors])
    vectors.setflags(write=False)
    return vectors
