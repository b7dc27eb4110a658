"""Measured changes of people's wavefronts from the axis to the periphery.

meridian         extension of the horizontal meridian to the visual field
people           measured people, all as right eyes
population       their mean and covariance
change           change of one eye, conditioned on its axis and other measurements
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
