"""OpenGL: context, memory and programs.

choose_device    choice of the EGL device
current_context  context of the caller; functions that moderngl lacks; kept state
gpu              context, buffers, textures
passes           preprocessing, compilation and dispatch of compute passes
stage_timer      times of a frame's stages
staging          persistently mapped memory for uploads and readbacks; timer queries
texture_io       textures, renderbuffers and memory of the caller or other processes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
