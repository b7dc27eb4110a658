"""Frame engine of OpenGL compute shaders.

renderer         the engine
gl_store         a PSF store with a copy of its kernels on the GPU
frame_run        one view, from upload to result
texture_frames   frames from textures to a texture of the caller
strips           division of a frame into strips that fit the buffers
strip            size and buffers of a frame or strip
fragment_passes  passes from pixels to fragments
list_passes      passes that build, sort and splat the fragment lists
frame_passes     all passes of a strip, and readback of the image
kernel_passes    passes that plan and blend an eye's kernels
eye_states       cached state of the two most recently used eyes
list_bands       division of fragment lists into bands that fit a buffer
compile_passes   compilation of all passes before the first frame
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
