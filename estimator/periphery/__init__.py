"""Change of wavefronts from the axis to the periphery in measured eyes.

population  data of measured eyes, their mean and covariance, over the field
change      change of one eye, conditioned on its axis and other measurements

The *change* is the wavefront in a direction minus that on the axis: terms 3 to 14 on a
circle of 4 mm about the chief ray, at the cornea.  It is stored at *knots*, azimuths of
the horizontal meridian.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
