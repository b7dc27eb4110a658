"""OpenGL: one owner of the context.

choose_device  on which device the context is opened
copying        copies of large images by several threads
egl_devices    which there are
gpu            context, buffers, textures
hardware       which renderers are a GPU
passes         programs, and how they are run
shader_source  shader text: includes, defines, line numbers
stage_timer    times of a frame's stages
staging        memory that both sides see, for what goes to the GPU and comes from it
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
