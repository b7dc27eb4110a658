"""Dynamics of the eye: pupil, accommodation and gaze over time.

responses  pupillary light reflex, and accommodation that follows the fixation distance
gaze       smoothed gaze of an eye tracker

Times are in seconds on any clock; each model is independent of the sampling rate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
