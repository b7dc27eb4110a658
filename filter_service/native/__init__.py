"""Compiled C loops of frames.

library        Python interface of the compiled library
functions      signatures of its functions
records        argument records, field by field
source/        C source code
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
