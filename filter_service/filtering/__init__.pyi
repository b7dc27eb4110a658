from .builder import Builder as Builder
from .eye_filter import EyeFilter as EyeFilter
from .filtered import Filtered as Filtered
from .several_eyes import plan_views as plan_views
from .stream_eyes import BuildingEye as BuildingEye
from .stream_eyes import EyeFailed as EyeFailed
from .stream_eyes import EyeReady as EyeReady
