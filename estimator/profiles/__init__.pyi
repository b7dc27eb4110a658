from .files import load_profile as load_profile
from .measured_wavefront import MeasuredWavefront as MeasuredWavefront
from .parse import EyeProfile as EyeProfile
from .parse import Measurement as Measurement
from .parse import parse_profile as parse_profile
from .parse import preset_names as preset_names
from .parse import published_names as published_names
from .typical_aberrations import drawn_profiles as drawn_profiles
