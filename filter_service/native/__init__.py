"""Compiled C loops: PSFs, and frames on machines without a GPU.

library        Python interface of the compiled library
records        argument records, field by field
source/        C source code
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
