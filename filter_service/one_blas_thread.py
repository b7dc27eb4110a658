"""Import before NumPy to keep its matrix products on the calling thread.

They are small.  With several threads, each one spins while waiting for cores that are
rendering frames: planning a grid during a stream took four times the processor time.
"""

import os

for _library in ("OPENBLAS", "MKL", "BLIS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
