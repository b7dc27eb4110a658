"""Scattering and absorption in the ocular media.

straylight  wide-angle scattering by age, pigmentation and cataract; absorption by age
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
