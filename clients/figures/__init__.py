"""Figures of an eye, for reports and web pages: matplotlib without pyplot, thread-safe.

    study = EyeStudy.of("keratoconus")
    mtf_figure(study).savefig("mtf.svg")

`NAME_figure` returns a new figure.  `draw_NAME` draws into axes, or into a figure or
subfigure if it needs several axes.

study           `EyeStudy`: one eye, estimated and traced once
pupil_wavefront  one wavefront in the pupil, and its transfer function
style           sizes, colors, fonts
wavefront       maps of a wavefront
orders          RMS by radial order, coefficients
psfs            images of point-spread functions
transfer_curves  contrast by spatial frequency
field_maps      refraction and blur over the visual field
drawn_curves    curves of persons drawn from the population
field_lines     their refraction along the horizontal meridian
acuity          visual acuity by distance
acuity_curves   curves of visual acuity
section         cross-section of the eye, with rays
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
