"""Frame engine of compiled loops (C), for machines without a GPU.

renderer      the engine, its state between frames, and two lanes
frame_record  input record of the loops, and the plan of kernels
frame_arrays  memory that frames reuse
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
