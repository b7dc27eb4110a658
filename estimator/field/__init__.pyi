from .eye_optics import EyeOptics as EyeOptics
from .interpolation import AberrationGrid as AberrationGrid
from .prepare import prepare_eye as prepare_eye
from .traced_eye import TracedEye as TracedEye
