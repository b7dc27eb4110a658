"""Streams of frames through eyes that may change on the way.

eye_filter        `EyeFilter`: one stream; the public API
planned_frame     a frame whose eye is known
several_eyes      a frame whose views have eyes of their own
filtered          a filtered frame, and events on the way
accepted_profile  one profile and the stores of it
stream_eyes       which eye serves, and what is to be estimated
warm_up           the states that the next frames of a stream will have
workshop          one worker and one engine for all streams
shared_workshop   the one that a process shares
choose_engine     which one filters here, and why
compile_loops     every compiled loop, made ahead on all cores
load_ahead        what frames need, loaded while nobody asks
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
