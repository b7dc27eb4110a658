"""Limits BLAS to one thread; import before NumPy.

Matrix products here are small, and idle BLAS threads spin.  With several threads,
planning a grid during a stream took four times the processor time.
"""

import os

for _library in ("OPENBLAS", "MKL", "BLIS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
