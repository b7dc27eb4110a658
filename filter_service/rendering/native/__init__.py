"""Frame engine of compiled loops, for machines without a GPU.

renderer      the engine: stages, and state kept between frames
lanes         two renderers, for small frames during large ones
native_store  a store with its coarse kernels
eye_states    state of each eye kept between frames
kernel_plan   kernels that a frame needs
frame_record  input record of the loops
arrays        buffers reused by frames
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
