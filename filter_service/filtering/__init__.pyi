from .builder import Builder as Builder
from .eye_filter import EyeFilter as EyeFilter
from .filtered import BuildingEye as BuildingEye
from .filtered import EyeFailed as EyeFailed
from .filtered import EyeReady as EyeReady
from .filtered import Filtered as Filtered
from .several_eyes import plan_views as plan_views
