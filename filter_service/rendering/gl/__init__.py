"""Frame engine of OpenGL compute shaders.

renderer         the engine: stores, frames, results
gl_store         a PSF store with a copy of its kernels on the GPU
frame_run        one view, from start to result
strips           division of a frame into strips that fit the buffers
strip            size and buffers of a frame or strip
fragment_passes  passes from pixels to fragments
list_passes      passes that build, sort and splat the lists
frame_passes     all passes of a strip, and the output image
kernel_passes    passes that blend a frame's kernels
expected_pairs   prediction of kernels from the previous frame
eye_states       state of two eyes kept between frames
list_bands       division of lists into bands that fit a buffer
compile_passes   compilation of every pass before the first frame
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
