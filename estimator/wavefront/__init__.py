"""Wavefronts of a stack of surfaces, traced from the retina outwards.

aberrations        coefficients at any field, pupil and wavelength; many eyes at once
results            what is known of wavefronts and their pupils
circle             on axis, on a given circle outside the eye, filled whatever the stop
bundle             one bundle of rays aimed at the stop and followed out
kernels            compiled steps of aiming and of optical paths
nodes              where the rays of a bundle cross the stop or a circle
fit                coefficients and the pupil's rim from rays
chief_rays         where chief rays of other colours end: lateral colour
chief_ray_kernels  its compiled loops
field_wavefronts   sets of wavefronts with their pupils, as PSFs are made of
moved_plane        coefficients carried from the cornea to the entrance pupil
pupil_refraction   least-squares refraction over the light that passes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
