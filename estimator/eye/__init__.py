"""The eye model: 45 parameters, surfaces and accommodation.

checked_fields  validation of single profile fields, errors with allowed ranges
parameters      the 45 parameters by name, as vectors, with their ranges
lens_shape      shape of the lens at constant volume
lens_change     lens diameter and chamber depth in accommodation
assembly        conversion of parameters to surfaces, for one eye or many
tracing         coefficients and refractions of many eyes
focusing        far point, near point, and notes on unreachable focus
focus_table     refraction over pupil and accommodation, and its inverse
accommodation   the lens state that focuses an eye at a distance
surface_model   an eye given by surfaces, in states of accommodation
surface_eye     its focus
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
