from .builder import Builder as Builder
from .eye_filter import EyeFilter as EyeFilter
from .operator import FilterOperator as FilterOperator
from .planned_frame import Filtered as Filtered
from .planned_frame import plan_views as plan_views
from .stream_eyes import BuildingEye as BuildingEye
from .stream_eyes import EyeFailed as EyeFailed
from .stream_eyes import EyeReady as EyeReady
