"""Import before numpy: its matrix products stay on the calling thread.

Ours are small.  Shared among threads, each waits in a loop for cores that frames are
rendered on: planning a grid beside a stream took four times the processor time.
"""

import os

for _library in ("OPENBLAS", "MKL", "BLIS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
