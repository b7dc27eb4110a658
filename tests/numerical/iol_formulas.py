"""Published formulas for the power of an intraocular lens, for emmetropia.

Each formula is a thin-lens calculation with a lens position of its own.

References
----------
SRK/T: Retzlaff, Sanders & Kraff, J. Cataract Refract. Surg. 16, 333 (1990), with the
erratum.  Hoffer Q: Hoffer, J. Cataract Refract. Surg. 19, 700 (1993), with the errata.
Holladay 1: Holladay et al., J. Cataract Refract. Surg. 14, 17 (1988).  Haigis: Haigis
et al., Graefes Arch. Clin. Exp. Ophthalmol. 238, 765 (2000), with a1 = 0.4, a2 = 0.1.
"""

import math


def srk_t_position_mm(length_mm, k_dpt, acd_mm):
    """The height of the cornea."""
    del acd_mm
    radius_mm = 337.5 / k_dpt
    if length_mm > 24.2:
        length_mm = -3.446 + 1.716 * length_mm - 0.0237 * length_mm**2
    width_mm = -5.41 + 0.58412 * length_mm + 0.098 * k_dpt
    return radius_mm - math.sqrt(radius_mm**2 - width_mm**2 / 4.0)


def holladay_1_position_mm(length_mm, k_dpt, acd_mm):
    del acd_mm
    radius_mm = max(337.5 / k_dpt, 7.0)
    width_mm = min(12.5 * length_mm / 23.45, 13.5)
    return 0.56 + radius_mm - math.sqrt(radius_mm**2 - width_mm**2 / 4.0)


def hoffer_q_position_mm(length_mm, k_dpt, acd_mm):
    del acd_mm
    sign, most_mm = (1.0, 28.0) if length_mm <= 23.0 else (-1.0, 23.5)
    return (
        0.3 * (length_mm - 23.5)
        + math.tan(math.radians(k_dpt)) ** 2
        + 0.1
        * sign
        * (23.5 - length_mm) ** 2
        * math.tan(math.radians(0.1 * (most_mm - length_mm) ** 2))
        - 0.99166
    )


def haigis_position_mm(length_mm, k_dpt, acd_mm):
    del k_dpt
    return 0.4 * acd_mm + 0.1 * length_mm


def srk_t_dpt(length_mm, k_dpt, lens_mm):
    optical_mm = length_mm + 0.65696 - 0.02029 * length_mm
    return _thin_lens_dpt(optical_mm, lens_mm, 337.5 / k_dpt, cornea_index=1.333)


def holladay_1_dpt(length_mm, k_dpt, lens_mm):
    return _thin_lens_dpt(
        length_mm + 0.2, lens_mm, 337.5 / k_dpt, cornea_index=4.0 / 3.0
    )


def _thin_lens_dpt(length_mm, lens_mm, radius_mm, *, cornea_index):
    index, step = 1.336, cornea_index - 1.0
    top = 1000.0 * index * (index * radius_mm - step * length_mm)
    return top / ((length_mm - lens_mm) * (index * radius_mm - step * lens_mm))


def hoffer_q_dpt(length_mm, k_dpt, lens_mm):
    behind = 1336.0 / (length_mm - lens_mm - 0.05)
    return behind - 1.336 / (1.336 / k_dpt - (lens_mm + 0.05) / 1000.0)


def haigis_dpt(length_mm, k_dpt, lens_mm):
    cornea_dpt = 331.5 / (337.5 / k_dpt)
    return 1336.0 / (length_mm - lens_mm) - 1336.0 / (1336.0 / cornea_dpt - lens_mm)


FORMULAS = {
    "SRK/T": (srk_t_dpt, srk_t_position_mm),
    "Holladay 1": (holladay_1_dpt, holladay_1_position_mm),
    "Hoffer Q": (hoffer_q_dpt, hoffer_q_position_mm),
    "Haigis": (haigis_dpt, haigis_position_mm),
}
"""Power from axial length, K and lens position; lens position but for its constant."""
