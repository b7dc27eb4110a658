"""Point-spread functions of wavefronts, by the method that holds for each.

compute            many PSFs at once: the entry
arguments          its arguments, checked
kernel_types       finished kernels and their buffers
pupil              the pupil's ellipse as a unit disc
survey             slopes, curvatures and sizes, before anything is computed
switch             waves or rays, by predicted error
fourier            wave optics by FFT
fourier_kernels    its compiled loops
geometric          ray optics with Fresnel's edge
geometric_kernels  its compiled loops
enz                the extended Nijboer-Zernike series
enz_series         its coefficients
tail               mean light far outside
stiles_crawford    the eye's apodisation
screens            rings in the pupil, of lenses with several foci
reference          the slow float64 truth
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
