"""Scattering and absorption in the ocular media.

straylight  scattering over wide angles, by age, pigment and cataract
absorption  absorption by the aging lens, mostly of blue light
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
