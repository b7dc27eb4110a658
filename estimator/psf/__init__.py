"""Point-spread functions (PSFs) of wavefronts, by wave optics or ray optics.

compute            entry point: many PSFs in one call
arguments          argument checks
compiled           the engine in C
discs              its PSFs over discs of given radii
kernel_types       result type, kernel buffer, kernel disc
drawing            PSFs on the axes of a figure
pupil              pupils in pixel coordinates
survey             wavefront slopes and kernel radii, before any PSF is computed
switch             choice of wave or ray optics, by predicted error
quadrature         PSFs in double precision, for derivatives
fourier            sampling of wave-optical PSFs
tables             tables and constants of the engine
enz                wave optics by the extended Nijboer-Zernike series
enz_series         functions and coefficients of the series
tail               mean diffracted light far outside the geometric spot
stiles_crawford    Stiles-Crawford apodization
screens            complex amplitude of multifocal lenses, tabulated

Terms:

- A *kernel* is a PSF integrated over pixels, ``[y, x]`` in image orientation, with unit
  sum, on the disc dx² + dy² <= (R + 0.5)² px².  Its center is the chief ray.
- The *pitch* is the visual angle of a pixel, mrad; in general, it is a Jacobian.
- A *grid* has the angular samples of a wave-optical PSF, a whole number per pixel.
- *t* are pupil coordinates in um/px, in which pixels are unit squares; see `pupil`.
- A *slope* is the gradient of W in t: the position of that point's ray, px.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
