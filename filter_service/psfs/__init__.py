"""PSFs on the nodes of a plan: computed on demand, packed, read for a frame.

eye_for_spec         the eye of a profile, for what a cache covers
compute_kernels      from nodes to packed kernels
psf_engine           in C, or in Python
native_psfs          the engine in C
boxes                what kernels are cut to
pack                 kernels cut to boxes, in 16 bits
store                the PSFs of an eye
frame_layers         how a state reads them, and the layers of a frame
field_defocus        change of defocus over the field
read_kernels         which cached kernels a state reads, as plain arrays
read_loops           the compiled loops that read them
layer_loops          where a frame's layers lie
store_cache          eyes and nodes kept on disk
cache_folder         where, if anywhere
kept_eyes            whose, to be listed and erased
store_codec          objects as JSON and arrays
store_file           the file they go to
picture              a kernel as a picture
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
