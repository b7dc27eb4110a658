"""The model eye: 45 parameters, its surfaces, its focus.

checked_fields  reading one field of a profile, every refusal with its range
parameters      the 45 parameters by name, as vectors, with their ranges
lens_shape      the lens at constant volume
lens_change     the lens at other diameters, and the chamber before it
assembly        from parameters to surfaces, one eye or many
explicit        an eye given surface by surface
tracing         coefficients and refractions of many eyes
focusing        far point, near point, and what is said where they end
focus_table     refraction over pupil and accommodation, and back
accommodation   the lens that focuses an eye at a distance
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
