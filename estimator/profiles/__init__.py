"""Eye profiles: prescriptions, measurements and eye models.

bodies               types of the profile object: fields, ranges, defaults
correction_bodies    the same for corrections
given_bodies         the same for eyes given by their surfaces, and all bodies
validation           conversion of plain data to these types, and its errors
eye_profile          the parsed profile
common_fields        from the fields that all types share, and the correction
parse                from a typed profile to an `EyeProfile`
surgery              surgery that a correction describes
given_eyes           from a typed profile to an eye given by its surfaces
surfaces             from typed surfaces to an eye; schematic eyes of the literature
reference            JSON Schema, tables and limits of the typed profiles
files                .json, .abp, .csv, .zmx and .txt profiles, and eyes by name
coefficient_files    tables of coefficients in .abp and .csv files
coefficient_table    the settings and coefficients that their lines state
coefficients         coefficients of a profile, in any order, as arrays in um
lens_files           eyes of lens files, and those in JSON files of optiland
zemax_files          eyes in .zmx files
fhir_files           prescriptions in JSON files of FHIR
irx3_files           measurements in .txt files of the aberrometer irx3
presets.json         the six presets
published/           schematic eyes with their sources
measured_wavefront   a measurement used in closed form, without an eye model
typical_aberrations  higher-order aberrations added to a prescription, by age or drawn
synteyes             eyes drawn from a statistical model of biometry
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
