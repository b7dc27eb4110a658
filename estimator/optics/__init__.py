"""Light and surfaces: what holds for any eye and any lens.

arrays            arrays in the one form that compiled loops take
units             unit conversions, reference wavelengths
zernike           the polynomials, their indices, rescaling, mirrors
media             refractive indices of the eye's media by wavelength
chromatic         chromatic difference of refraction of the average eye
prescription      spectacle prescriptions, power vectors, their coefficients
surfaces          one surface, a stack of them, and both packed for compiled loops
raytrace          rays through a stack of surfaces, each with its status
raytrace_kernels  its compiled loops
paraxial          vergences and pupils near the axis
vergence          the plane of the entrance pupil: distances, spectacles
pupil_screen      rings in the pupil, as wave optics asks of them
pinhole           directions and local scale of a pinhole image
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
