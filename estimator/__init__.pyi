from .acuity.predict import log_mar_of as log_mar_of
from .acuity.predict import predict_acuity as predict_acuity
from .acuity.sensitivity import perfect_transfer as perfect_transfer
from .acuity.transfer import Transfer as Transfer
from .acuity.transfer import optical_transfer as optical_transfer
from .estimate.estimation import EstimatedEye as EstimatedEye
from .estimate.estimation import estimate_eye as estimate_eye
from .estimate.plot import draw_section as draw_section
from .eye.checked_fields import ProfileError as ProfileError
from .eye.parameters import EyeParameters as EyeParameters
from .field.eye_optics import EyeOptics as EyeOptics
from .field.field_table import FieldTable as FieldTable
from .field.field_table import field_table as field_table
from .field.prepare import prepare_eye as prepare_eye
from .optics.chromatic import chromatic_refraction_dpt as chromatic_refraction_dpt
from .optics.prescription import Prescription as Prescription
from .optics.prescription import power_vector as power_vector
from .optics.prescription import power_vector_from_zernike as power_vector_from_zernike
from .optics.prescription import (
    prescription_from_power_vector as prescription_from_power_vector,
)
from .optics.zernike import nm_from_index as nm_from_index
from .optics.zernike import rescale_pupil as rescale_pupil
from .optics.zernike import zernike_values as zernike_values
from .profiles.files import load_profile as load_profile
from .profiles.files import profile_body as profile_body
from .profiles.parse import EyeProfile as EyeProfile
from .profiles.parse import parse_profile as parse_profile
from .profiles.parse import preset_names as preset_names
from .psf.compute import compute_psf_batch as compute_psf_batch
from .psf.compute import compute_psfs as compute_psfs
from .threads import thread_count as thread_count
from .wavefront.aberrations import wavefront_aberrations as wavefront_aberrations
