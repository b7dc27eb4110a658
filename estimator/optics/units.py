"""Unit conversions and reference wavelengths."""

import math

NM_PER_UM = 1000.0
UM_PER_MM = 1000.0
MM_PER_M = 1000.0
MRAD_PER_RAD = 1000.0

REFERENCE_WAVELENGTH_NM = 555.0
"""Wavelength at which accommodation and pupil sizes are defined (CONVENTIONS.md)."""

RGB_WAVELENGTHS_NM = (618.0, 536.0, 453.0)
"""Wavelengths that represent the primaries of common displays; see
`filter_service.displays`."""

SPHERE_PER_C20 = 4.0 * math.sqrt(3.0)
"""M [dpt] = -4 sqrt(3) C(2,0) [um] / radius² [mm²] (Thibos 2002)."""

ASTIGMATISM_PER_C22 = 2.0 * math.sqrt(6.0)
"""J [dpt] = -2 sqrt(6) C(2,±2) [um] / radius² [mm²] (Thibos 2002)."""
