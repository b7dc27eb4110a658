"""Wavefronts of an eye over its visual field, the input of the PSF cache.

eye_optics              interface between the PSF cache and an eye
interpolation           wavefronts at the nodes of a grid, and between the nodes
peripheral_residual     difference between the population's periphery and the model's,
                        at every accommodation
traced_fields           traced part of the field; wavefronts at fixed fields, as pupil
                        and accommodation change
traced_eye              an estimated eye, ray-traced over the field
prepare                 entry point: from a profile to such an eye, with notes
network_eye             entry point of the published pipeline, whose eyes are estimated
                        by networks
field_table             wavefronts at the cornea in many directions, also of randomly
                        sampled people
field_figure            their maps and PSFs

A *field* is a direction in the visual field, azimuth h and elevation v.  A *grid* has
axes of h, v, pupil, accommodation and wavelength.  The *state* of an eye is its pupil
and its accommodation.  The *total defocus* is the least-squares refraction of a state.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
