"""Streams of frames through eyes that may change during the stream.

eye_filter        `EyeFilter`: one stream; the public API
planned_frame     a frame whose eye is prepared
several_eyes      a frame whose views have different eyes
filtered          a filtered frame, and events of an eye
accepted_profile  one profile and its stores
stream_eyes       the eyes of a stream: requested, building, ready
predicted_states  prediction of the next frames' states
builder           builder and engine shared by all streams
shared_builder    builders shared within a process
choose_engine     choice of the engine, with the reason
compile_loops     compilation of all loops, on all cores
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
