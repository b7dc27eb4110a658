"""Dynamics of the eye: pupil, accommodation and gaze.

accommodation_response  accommodation over time
pupil_size              pupil diameter in steady light
pupil_reflex            pupil diameter over time
gaze                    smoothed gaze of a tracker, with a fallback
delayed_approach        value that follows its target after a latency
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
