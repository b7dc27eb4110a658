"""Point-spread functions (PSFs) of wavefronts, by wave optics or ray optics.

compute            entry point: many PSFs in one call
arguments          argument checks
kernel_types       result type, kernel buffer, kernel disc
pupil              pupils in pixel coordinates
survey             wavefront slopes and kernel radii, before any PSF is computed
switch             choice of wave or ray optics, by predicted error
fourier            wave optics by FFT
fourier_kernels    its compiled loops
geometric          ray optics plus diffraction at the edge of the pupil
geometric_kernels  its compiled loops
enz                wave optics by the extended Nijboer-Zernike series
enz_series         functions and coefficients of the series
tail               mean diffracted light far outside the geometric spot
stiles_crawford    Stiles-Crawford apodization
screens            complex amplitude of multifocal lenses, tabulated

Terms:

kernel   a PSF integrated over pixels, ``[y, x]`` in image orientation, with unit sum,
on
         the disc dx² + dy² <= (R + 0.5)² px²; its center is the chief ray
pitch    the visual angle of a pixel, mrad; in general, a Jacobian from mrad to px
grid     angular samples of a wave-optical PSF, a whole number per pixel
t        pupil coordinates in um/px, in which pixels are unit squares (see `pupil`)
slope    gradient of W in t, px: where a ray of that pupil point meets the image
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
