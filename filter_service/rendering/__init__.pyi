from .engine import FrameEngine as FrameEngine
from .engine import LoadedStore as LoadedStore
from .engine import ViewRequest as ViewRequest
