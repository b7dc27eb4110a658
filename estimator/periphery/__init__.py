"""How people's wavefronts change from the axis to the periphery, measured.

meridian         the visual field from the horizontal meridian
people           measured people, all as right eyes
population       their mean and covariance
change           what one eye is like, by its axis and what else was measured
make_population  makes ``population.json`` anew
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
