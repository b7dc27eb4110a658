"""Wavefronts of a stack of surfaces, traced from the retina outward.

aberrations        coefficients at any field, pupil and wavelength; many eyes at once
results            results for wavefronts and their pupils
circle             wavefront on a given circle outside the eye, regardless of the stop
bundle             ray bundle aimed at the stop and traced out of the eye
kernels            compiled ray aiming and optical paths
nodes              sampling points of the stop or a circle
fit                coefficients and the pupil's rim from rays
chief_rays         chief rays of other colors: lateral color
chief_ray_kernels  its compiled loops
field_wavefronts   wavefronts over the field with their pupils, input of the PSF engines
moved_plane        coefficients transferred from the cornea to the entrance pupil
pupil_refraction   least-squares refraction over the light that passes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
