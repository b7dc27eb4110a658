"""Point-spread functions of wavefronts, each by the method that is valid for it.

compute            entry point: many PSFs at once
arguments          argument checks
kernel_types       finished kernels and their buffers
pupil              the pupil's ellipse as a unit disc
survey             pre-pass: slopes, curvatures and sizes
switch             choice of waves or rays, by predicted error
fourier            wave optics by FFT
fourier_kernels    its compiled loops
geometric          ray optics with Fresnel's edge
geometric_kernels  its compiled loops
enz                the extended Nijboer-Zernike series
enz_series         its coefficients
tail               mean light far outside the spot
stiles_crawford    the eye's apodization
screens            rings in the pupil, of lenses with several foci
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
