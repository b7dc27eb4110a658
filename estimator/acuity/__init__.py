"""Optical transfer functions of eyes and predicted visual acuity.

transfer     optical transfer functions of wavefronts
sensitivity  contrast sensitivity: of the whole visual system, and neural
predict      visual Strehl ratio and acuity of a wavefront
best_correction  sphere and cylinder of the highest visual Strehl ratio
retina       sampling density of the retina
curves       acuity through focus and over the field

Spatial frequencies are in cycles per degree (``_cpd``).  Acuity is in logMAR, the
decimal logarithm of the smallest legible gap in minutes of arc.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
