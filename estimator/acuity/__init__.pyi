from .predict import Acuity as Acuity
from .predict import predict_acuity as predict_acuity
from .sensitivity import mean_eye_transfer as mean_eye_transfer
from .sensitivity import neural_sensitivity as neural_sensitivity
from .transfer import Transfer as Transfer
from .transfer import optical_transfer as optical_transfer
