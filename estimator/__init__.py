"""The eye: what is known of it, what it is like, and what light it lets through.

From a profile to PSFs: `load_profile`, `estimate_eye` or `prepare_eye`, `compute_psfs`.

    optics/        light and surfaces
    wavefront/     wavefronts of surfaces, traced
    acuity/        what the optics leave of detail, and what is read with it
    dynamics/      what drives an eye: light, distance, gaze
    media/         light that is scattered or absorbed on the way
    psf/           point-spread functions of wavefronts
    corrections/   what people wear to see better
    eye/           the 45-parameter model
    profiles/      what is known of one eye
    networks/      the trained networks
    periphery/     how people's wavefronts change off the axis, measured
    estimate/      from a measurement to the eye
    field/         an eye over its visual field
    bounded_files  text and JSON of untrusted files within limits
    threads        how many threads this machine gives us
    machine_speed  how fast one of its cores is
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
