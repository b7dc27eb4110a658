"""The frame engine of OpenGL compute shaders.

renderer         the engine: layers, strips, the answer
frame_passes     lists, order and splat of a frame
fragment_passes  pixels to fragments
kernel_passes    a frame's kernels
list_bands       lists in bands that fit a buffer
compile_passes   every pass compiled before the first frame
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
