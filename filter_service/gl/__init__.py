"""OpenGL: one owner of the context.

gpu            context, buffers, textures, programs, timers
hardware       which renderers are a GPU
shader_source  shader text: includes, defines, line numbers
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
