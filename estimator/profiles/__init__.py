"""Eye profiles: prescriptions, measurements and eye models.

parse                validation of a profile object, returned as an `EyeProfile`
correction           the correction in a profile
options              options of any kind of profile
files                .json, .abp and .csv profiles, and presets by name
presets.json         the six presets
measured_wavefront   a measurement used in closed form, without an eye model
typical_aberrations  higher-order aberrations added to a prescription, by age
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
