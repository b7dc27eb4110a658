"""Transfer functions of an eye's optics and predicted visual acuity.

transfer     optical transfer functions of wavefronts
sensitivity  contrast sensitivity of people, with and without their optics
predict      visual Strehl ratio and acuity
best_correction  sphere and cylinder of the highest visual Strehl ratio
retina       sampling density of the retina
curves       acuity through focus and over the field
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
