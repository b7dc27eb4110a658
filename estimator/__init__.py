"""Eye model, wavefronts and point-spread functions.

`Eye` has the PSFs, the MTF and the acuity of a profile.  Step by step: `load_profile`,
`estimate_eye` or `prepare_eye`, `compute_psfs`.

    optics/        light and surfaces
    wavefront/     ray-traced wavefronts of surfaces
    acuity/        image quality metrics and visual acuity
    dynamics       pupil, accommodation and gaze over time
    color/         cone signals and CIE XYZ of spectra
    media          scattering and absorption in the ocular media
    psf/           point-spread functions of wavefronts
    corrections/   spectacles, contact lenses and intraocular lenses
    eye/           the 45-parameter eye model
    profiles/      descriptions of one person's eye
    networks/      the trained networks
    periphery/     measured changes of wavefronts off the axis
    estimate/      estimation of an eye from a measurement
    field/         wavefronts of an eye over its visual field
    image_quality/  PSF, MTF, refraction and acuity of an eye, with named axes
    native/        the compiled core: threads, PSFs
    note           notes for the user, with codes and numbers
    bounded_files  size-limited reading of untrusted text and JSON
    threads        number of threads to use, and the speed of one core
    version        version of the installed package
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
