"""The frame engine of OpenGL compute shaders.

renderer         the engine: stores, frames, the answer
frame_run        a view begun, and finished later
strips           a frame cut so that its buffers fit
strip            a frame or strip: size and buffers
fragment_passes  pixels to fragments
list_passes      lists, order, splat
frame_passes     all of them, and the picture
kernel_passes    a frame's kernels
expected_pairs   kernels told from the frame before
kept_eyes        what of two eyes is kept between frames
list_bands       lists in bands that fit a buffer
compile_passes   every pass compiled before the first frame
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
