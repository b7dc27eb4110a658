"""Wavefronts of an eye, from rays traced from the retina outward.

aberrations       Zernike coefficients by field, pupil and wavelength; of many eyes
compiled          calls of the compiled tracer for many packed eyes, and its results
nodes             quadrature nodes over the stop or a circle
field_wavefronts  wavefronts over the field with their pupils, input of the PSF engines
moved_plane       transfer of a wavefront to another plane along the chief ray

Wavefronts are given in a plane normal to the chief ray, outside the eye: where the
chief ray meets the cornea, or where it crosses the plane of the paraxial *entrance
pupil*.  W is the optical path of the chief ray minus the path of a ray, positive where
light is ahead.  Coefficients use OSA/ANSI order and normalization, to radial order 6,
on the *circle* about the chief ray that circumscribes the *rim* of the pupil.  Piston
is zero.  Tilt is kept, so that it balances coma at the chief ray.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
