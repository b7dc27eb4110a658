"""Figures of an eye, for reports and web pages: matplotlib without pyplot, thread-safe.

    study = EyeStudy.of("keratoconus")
    mtf_figure(study).savefig("mtf.svg")

`NAME_figure` returns a new figure.  `draw_NAME` draws into axes, or into a figure or
subfigure if it needs several axes.

study      `EyeStudy`: one eye, estimated and traced once; its wavefronts and acuity
style      sizes, colors, fonts
wavefront  maps of a wavefront, orders, coefficients, point images, section of the eye
curves     contrast, acuity and refraction by frequency, distance and direction, and
           curves of persons drawn from the population
defocus    maps of defocus over the field, with zones and lenslets
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
