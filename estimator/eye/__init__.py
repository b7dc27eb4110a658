"""The eye model: 45 parameters, surfaces and accommodation.

checked_fields  errors of profiles
parameters      the 45 parameters by name, as vectors, with their ranges
assembly        conversion of parameters to surfaces, and the shape of the lens
tracing         coefficients and refractions of many eyes
focusing        far point, near point, and notes on unreachable focus
accommodation   the lens state that focuses an eye at a distance
surface_eye     an eye given by surfaces, in states of accommodation, and its focus
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
