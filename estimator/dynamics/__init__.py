"""Dynamics of the eye: pupil, accommodation and gaze over time.

accommodation_response  accommodation that follows the fixation distance
pupil_size              steady-state pupil diameter
pupil_reflex            pupillary light reflex
gaze                    smoothed gaze of an eye tracker
delayed_approach        exponential approach to a target after a latency

Times are in seconds on any clock; each model is independent of the sampling rate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
