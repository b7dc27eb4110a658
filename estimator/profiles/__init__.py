"""Eye profiles: prescriptions, measurements and eye models.

bodies               types of the profile object: fields, ranges, defaults
given_bodies         the same for eyes given by their surfaces, and all bodies
correction_bodies    the same for corrections
surface_bodies       the same for surfaces, their forms and media
implant_bodies       the same for implants and biometry
validation           conversion of plain data to these types, and its errors
eye_profile          the parsed profile
common_fields        from the fields that all types share to those of a profile
repeats              repeated measurements of one direction, averaged or refused
parse                from a typed profile to an `EyeProfile`
correction           from a typed correction to a lens
given_eyes           from a typed profile to an eye given by its surfaces
surfaces             from typed surfaces to an eye
pseudophakic         from biometry and an implant to an eye
published            schematic eyes from the literature with their sources
reference            JSON Schema, tables and limits of the typed profiles
files                .json, .abp, .csv and .zmx profiles, and eyes by name
coefficient_files    tables of coefficients in .abp and .csv files
coefficient_table    settings and terms of such a file
zemax_files          eyes in .zmx files
optiland_files       eyes in JSON files of optiland
lens_files           from surfaces of a lens file to the body of an eye
presets.json         the six presets
measured_wavefront   a measurement used in closed form, without an eye model
typical_aberrations  higher-order aberrations added to a prescription, by age
drawn_people         profiles of persons drawn from the population
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
