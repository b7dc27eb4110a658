"""What the eye's media do to light beside bending it.

straylight  light that is scattered over wide angles, by age, pigment and cataract
absorption  light that the ageing lens keeps, blue first
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
