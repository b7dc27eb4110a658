"""Color of spectra: cone signals and CIE XYZ.

observers  cone fundamentals by age and field size, color-matching functions, and the
           weights of spectral bands in LMS and XYZ
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
