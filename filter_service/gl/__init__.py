"""OpenGL: context, memory and programs.

choose_device  choice of the EGL device
copying        multithreaded copies of large arrays
egl_devices    list of the EGL devices
gpu            context, buffers, textures
hardware       detection of GPUs and software renderers
passes         compilation and dispatch of compute passes
shader_source  shader preprocessor: includes, defines, line numbers
stage_timer    times of a frame's stages
staging        persistently mapped memory for uploads and readbacks
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
