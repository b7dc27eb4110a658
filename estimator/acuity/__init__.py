"""What an eye's optics leave of detail, and what a person would read with it.

transfer     transfer functions of wavefronts
sensitivity  contrast that people see, with and without their optics
predict      visual Strehl ratio and acuity
retina       how fine the retina samples
curves       acuity through focus and over the field
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
