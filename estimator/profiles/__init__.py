"""Eye profiles: prescriptions, measurements and eye models.

bodies               types of the profile object: fields, ranges, defaults
correction_bodies    the same for corrections
surface_bodies       the same for eyes by surfaces, their forms and media
validation           conversion of plain data to these types, and its errors
parse                from a typed profile to an `EyeProfile`
correction           from a typed correction to a lens
surfaces             from typed surfaces to an eye
published            schematic eyes from the literature with their sources
reference            JSON Schema, tables and limits of the typed profiles
files                .json, .abp and .csv profiles, and presets by name
presets.json         the six presets
measured_wavefront   a measurement used in closed form, without an eye model
typical_aberrations  higher-order aberrations added to a prescription, by age
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
