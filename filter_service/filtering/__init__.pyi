from .eye_filter import EyeFilter as EyeFilter
from .filtered import BuildingEye as BuildingEye
from .filtered import EyeFailed as EyeFailed
from .filtered import EyeReady as EyeReady
from .filtered import Filtered as Filtered
from .one_image import filter_one_image as filter_one_image
from .one_image import image_spec as image_spec
from .workshop import Workshop as Workshop
