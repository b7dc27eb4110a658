"""Optical transfer functions of eyes and predicted visual acuity.

transfer         optical transfer functions, of one wavelength and of white light, and
                 human contrast sensitivity
letters          the ten Sloan letters
observer         acuity of an observer who reads letters through a transfer function
predict          visual Strehl ratio and acuity of a wavefront, through focus and over
                 the field, where the density of retinal cells limits acuity
best_correction  sphere and cylinder with the highest visual Strehl ratio

Spatial frequencies are in cycles per degree (``_cpd``).  Acuity is in logMAR, the
decimal logarithm of the smallest legible gap in minutes of arc.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
