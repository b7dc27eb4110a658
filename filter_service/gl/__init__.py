"""OpenGL: context, memory and programs.

choose_device      choice of the EGL device
copying            multithreaded copies of large arrays
current_context    context of the caller
egl_devices        list of the EGL devices
functions          OpenGL functions that moderngl does not offer
gpu                context, buffers, textures
hardware           detection of GPUs
imported_textures  textures in memory of another process
kept_state         state of the caller that passes leave as it is
passes             compilation and dispatch of compute passes
renderbuffers      renderbuffers of the caller, and copies to sample
shader_source      shader preprocessor: includes, defines, line numbers
stage_timer        times of a frame's stages
staging            persistently mapped memory for uploads and readbacks
texture_io         textures of the caller as input and output
timer_query        timer queries that can be deleted
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
