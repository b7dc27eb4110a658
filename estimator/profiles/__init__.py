"""What is known of one eye: a prescription, a measurement, an eye.

parse                a profile's object, checked, as an `EyeProfile`
worn                 what it says is worn
options              what any profile may ask for besides
files                .json, .abp and .csv profiles, and presets by name
presets.json         the six presets
measured_wavefront   a profile as the measurement by formula, without a model eye
typical_aberrations  what people have beside their prescription, by age
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
