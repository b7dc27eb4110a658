from .correction import Correction as Correction
from .correction import correct as correct
from .sensitivity import SensitivityWeight as SensitivityWeight
from .solver import PictureOperator as PictureOperator
from .solver import PictureSolution as PictureSolution
from .solver import nearest_picture as nearest_picture
