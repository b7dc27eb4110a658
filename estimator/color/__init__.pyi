from .observers import color_matching as color_matching
from .observers import cone_fundamentals as cone_fundamentals
from .observers import lms_weights as lms_weights
from .observers import xyz_weights as xyz_weights
