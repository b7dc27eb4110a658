from .engine import FrameEngine as FrameEngine
from .engine import ViewRequest as ViewRequest
from .frame_states import FrameStore as FrameStore
