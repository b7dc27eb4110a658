"""An eye over its whole visual field, as the PSF cache asks for it.

eye_optics       what the cache asks of any eye
aberration_grid  wavefronts traced at the nodes of a grid
network_grid     the same by network
few_colors       one wavelength traced, the others beside it
grid_source      which of the two, by cost and error
interpolation    between the nodes
peripheral_rest  what people's periphery has beyond the model's
trace_range      what of the field is traced
traced_fields    fixed fields, changing pupil and focus
fixed_defocus    their defocus alone
defocus_loops    its compiled loop
traced_eye       an estimated eye, ray-traced over the field
prepare          from a profile to such an eye: the entry
field_table      its wavefronts in many directions, as an instrument gives them
plot             maps of them
notes            what is said of how it was made
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
