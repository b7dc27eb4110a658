"""Optical quality of an eye: PSF, MTF, refraction and acuity as labeled arrays.

eye            `Eye`: an eye by its profile, for any list of states
states         combinations of states from numbers and lists
traced_states  wavefronts of an eye in these states, each traced once
pupil_light    light of one wavefront: transfer functions, PSFs, encircled energy
labeled_array  the result type: an array with named axes
plot           its figure
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
