"""What drives an eye from moment to moment: light, distance, gaze.

accommodation_response  focus that follows what is looked at
pupil_size              the pupil that steady light leaves
pupil_reflex            and how it follows light
gaze                    a tracker's gaze, smoothed, and what is done without
delayed_approach        a value that follows its target after a latency
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
