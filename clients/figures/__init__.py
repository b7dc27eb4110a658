"""Figures of an eye, for reports and pages: matplotlib without pyplot, safe in threads.

    study = EyeStudy.of("keratoconus")
    mtf_figure(study).savefig("mtf.svg")

`NAME_figure` gives a figure of its own, `draw_NAME` draws into axes, or into a figure
or part of one where it needs several axes.

study           `EyeStudy`: one eye, estimated and traced once
pupil_wavefront  one wavefront, and what its optics pass on
style           sizes, colours, type
wavefront       maps of a wavefront
orders          RMS by radial order, coefficients
psfs            what becomes of a point of light
transfer_curves  contrast by spatial frequency
field_maps      refraction and blur over the visual field
acuity          what can be read at each distance
acuity_curves   and as curves
section         the eye, cut, with rays
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
