"""Properties of an estimated eye that would be unusual in a person.

These limits are soft: the prior draws an eye toward usual values, but a wavefront may
require others.  Lengths are three deviations about the means of 19,500 to 90,800 eyes
of ten countries (axial length 23.49 ± 1.35 mm, corneal radius 7.69 ± 0.28 mm, chamber
depth with the cornea 3.10 ± 0.47 mm: "Global metrics on ocular biometry", Eye 2022).
The cornea's power follows from its radii; the lens has 22.6 ± 2.1 dpt (Rozema 2012).
"""

from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.optics.paraxial import cardinal_points
from estimator.optics.units import REFERENCE_WAVELENGTH_NM

USUAL = {
    "corneal power": ((38.5, 48.5), "dpt"),
    "lens power": ((16.3, 28.9), "dpt"),
    "chamber depth": ((1.7, 4.5), "mm"),
    "eye length": ((19.4, 27.6), "mm"),
}


def unusual(
    parameters: EyeParameters, *, retina: RetinaShape | None = None
) -> tuple[str, ...]:
    """Return the properties outside their usual ranges, with value and range."""
    points = cardinal_points(
        eye_surfaces(parameters, retina=retina), wavelength_nm=REFERENCE_WAVELENGTH_NM
    )
    depth_mm = parameters.cornea_thickness_mm + parameters.aqueous_thickness_mm
    values = {
        "corneal power": points.cornea_power_dpt,
        "lens power": points.lens_power_dpt,
        "chamber depth": depth_mm,
        "eye length": parameters.eye_length_mm,
    }
    return tuple(
        f"{name} {value:.1f} {USUAL[name][1]} (usual {low:g} to {high:g})"
        for name, value in values.items()
        for low, high in [USUAL[name][0]]
        if not low <= value <= high
    )
