"""Frame engine of compiled loops (C), for machines without a GPU.

renderer      the engine: stages of a frame, and state between frames
lanes         two renderers, so that small frames can interrupt large ones
native_store  a PSF store with additional kernels of coarse resolution
eye_states    cached state of the most recently used eyes
kernel_plan   plan of a frame's kernels
frame_record  input record of the loops
arrays        reusable buffers
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
