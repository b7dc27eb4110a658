"""Frame engine of OpenGL compute shaders.

renderer         the engine, and compilation of all passes
gl_store         a PSF store with a copy of its kernels on the GPU
frame_run        one view, from upload to result, and all its passes
texture_frames   frames from textures to a texture of the caller
strip            size and buffers of a strip, and division into strips
fragment_passes  passes from pixels to fragments
list_passes      passes that build, sort and splat lists, in bands
kernel_passes    passes that plan and blend an eye's kernels
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
