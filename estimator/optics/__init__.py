"""Surfaces, media, ray tracing, paraxial optics and Zernike polynomials.

units             unit conversions, reference wavelengths
zernike           Zernike polynomials: indices, values, gradients, rescaling, mirroring
zernike_orders    coefficients in the orders, normalizations and units of programs
zernike_words     coefficients in words
media             refractive indices by wavelength: ocular media, formulas, tables
gradients         gradient-index media
forms             surface forms other than conics, biconics and offset terms
prescription      spectacle prescriptions, power vectors, Zernike coefficients
surfaces          surfaces of an eye, and their packing for compiled code
raytrace          exact ray tracing, with a status per ray
paraxial          power, cardinal points and entrance pupil
vergence          object distances and vergences, and refraction by wavelength
pupil_screen      interface of a complex amplitude in the pupil, for wave optics
pinhole           directions and local scale of a pinhole image
interpolation     splines and polynomials through given points

Terms:

- A *surface* has a *form* (its sag), a position and a rotation.
- A *medium* is the material between two surfaces.  It is homogeneous, with an index by
  wavelength, its *dispersion*, or a *gradient*, with an index by position.
- The *stop* is the plane of the iris; its image by the cornea is the *entrance pupil*.
- The *chief ray* is the ray through the center of the stop.
- A *packed eye* is the array of numbers that compiled code traces rays through.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
