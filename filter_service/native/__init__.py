"""Compiled loops, for machines without a GPU: frames, and PSFs.

library        the loops, as Python calls them
records        what they are called with, field by field
source/        the loops, in C
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
