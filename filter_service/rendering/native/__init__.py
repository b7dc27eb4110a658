"""The frame engine of compiled loops, for machines without a GPU.

renderer       the engine: stages, what is kept between frames
lanes          two renderers, for small frames beside large ones
native_store   a store with its coarse kernels
kept_states    what is kept of each eye between frames
kernel_plan    the kernels that a frame needs
frame_record   what the loops are told
arrays         memory that frames use again
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
