from .estimation import EstimatedEye as EstimatedEye
from .estimation import estimate_eye as estimate_eye
from .given_surfaces import GivenSurfaces as GivenSurfaces
from .model import EyeModel as EyeModel
from .model import eye_model as eye_model
from .plot import plot_eye as plot_eye
