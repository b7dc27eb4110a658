"""OpenGL: the context and everything that uses it directly.

choose_device  choice of the EGL device of the context
copying        multithreaded copies of large images
egl_devices    list of the EGL devices
gpu            context, buffers, textures
hardware       detection of GPUs and software renderers
passes         compilation and dispatch of programs
shader_source  shader text: includes, defines, line numbers
stage_timer    times of a frame's stages
staging        mapped memory for transfers to and from the GPU
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
