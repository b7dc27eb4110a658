"""Optics common to all eyes and lenses.

arrays            arrays in the form that compiled loops require
units             unit conversions, reference wavelengths
zernike           the polynomials, their indices, rescaling, mirrors
media             refractive indices of the eye's media by wavelength
dispersion/       refractive index of other media by formula, Abbe number or table
gradients/        gradient-index media
forms/            forms of surfaces besides conics, biconics and offset terms
packed            columns of the arrays that describe an eye to compiled code
chromatic         chromatic difference of refraction of the average eye
prescription      spectacle prescriptions, power vectors, their coefficients
surfaces          one surface, a stack of them, and both packed for compiled loops
raytrace          rays through a stack of surfaces, each with its status
raytrace_kernels  its compiled loops
surface_kernels   intersection with one surface and refraction, compiled
gradient_kernels  rays through gradient-index media, compiled
paraxial          first-order power, cardinal points and pupils
vergence          the plane of the entrance pupil: distances, spectacles
pupil_screen      interface of rings in the pupil, for wave optics
pinhole           directions and local scale of a pinhole image
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
