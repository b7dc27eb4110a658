"""Wavefronts of an eye over its whole visual field, the input of the PSF cache.

eye_optics           interface between the PSF cache and any eye
aberration_grid      wavefronts traced at the nodes of a grid
few_colors           one wavelength traced densely, the others sparsely
interpolation        interpolation between the nodes
peripheral_residual  difference between people's periphery and the model's
trace_range          traced part of the field
traced_fields        fixed fields, changing pupil and focus
fixed_defocus        total defocus at fixed fields
defocus_loops        compiled loop of fixed_defocus
traced_eye           an estimated eye, ray-traced over the field
prepare              entry point: from a profile to such an eye
field_table          wavefronts in many directions, as an instrument reports them
plot                 maps of a field table
notes                notes on how an eye was computed
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
