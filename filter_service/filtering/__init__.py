"""`EyeFilter`: filters streams of frames through eyes, in process.

A *stream* is the frames of one filter.  Its profile may change: an *accepted profile*
is built in the build worker, its first PSFs are computed, and then it is *ready* and
replaces the previous one.  A *store* is the PSF cache of one eye for one camera.  The
*builder* advances the builds of all streams of a process.

eye_filter        `EyeFilter`: one stream
band_filter       `BandFilter`: images of many wavelengths
operator          `FilterOperator`: the filter of a frame as a matrix
derivatives       derivatives of images by parameters of state and profile
planned_frame     a frame whose eyes are prepared, and `Filtered`
stream_eyes       the profiles of a stream, their stores and events
frame_history     the last frames of a stream, which predict the next ones
builder           builder and engine shared by all streams
store_load        loading of built stores
psf_work          PSFs that are computed beside frames
priority_lock     lock of frames and of the thread that prepares eyes
shared_builder    builders shared within a process, and the choice of their engine
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
