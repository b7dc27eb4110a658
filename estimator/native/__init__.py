"""The compiled core: thread pool, rays and wavefronts, PSFs.

library        Python interface of compiled libraries
functions      signatures of this library's functions
records        its argument records, field by field
source/        C source code
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
