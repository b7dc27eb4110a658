from .estimation import EstimatedEye as EstimatedEye
from .estimation import estimate_eye as estimate_eye
from .plot import plot_eye as plot_eye
