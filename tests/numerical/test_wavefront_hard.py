"""Hard cases: finite coefficients, or a status that says what failed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.raytrace import RayStatus
from estimator.optics.surfaces import Surface
from estimator.wavefront.aberrations import wavefront_aberrations
from tests.numerical.schematic_eyes import irregular_eye, navarro, on_radius, reference

REFERENCE = reference()


def test_vignetting_equals_the_smaller_stop_it_makes():
    """An extra plate of no power in the stop plane, with a clear radius of 1.6 mm."""
    eye = navarro(REFERENCE)
    plate = Surface(
        (math.inf, math.inf), 0.0, eye.stop_z_mm - 1e-5, "aqueous", clear_radius_mm=1.6
    )
    clipped = replace(eye, surfaces=(*eye.surfaces[:2], plate, *eye.surfaces[2:]))
    view = {"wavelength_nm": 555.0, "h_deg": 20.0, "v_deg": -8.0}
    whole = wavefront_aberrations(eye, stop_diameter_mm=3.2, **view)
    found = wavefront_aberrations(clipped, stop_diameter_mm=5.0, **view)
    assert found.worst_status == RayStatus.CLIPPED
    assert "vignetted to 41.0%" in found.notes[0]
    assert abs(found.open_ratio - (3.2 / 5.0) ** 2) < 1e-4
    # The clear circle and the stop are 1e-5 mm apart; the rim has 24 points.
    error_um = np.abs(on_radius(found, whole.zernike_radius_mm) - whole.zernike_um)
    assert error_um[1:].max() < 1e-4


HARD_EYES = {
    "steep cornea": {"radius_mm": (6.2, 6.2), "conic_constant": 0.0},
    "flat cornea": {"radius_mm": (9.4, 9.4), "conic_constant": -1.5},
    "toric": {"radius_mm": (6.6, 8.6)},
    "no curvature along x": {"radius_mm": (math.inf, 8.0)},
}


def _keratoconus():
    offset_mm = np.zeros(28)
    offset_mm[[1, 4, 6, 7, 12, 17, 24]] = [0.1, 0.08, 0.05, 0.06, 0.04, 0.03, -0.03]
    return {"radius_mm": (6.3, 6.8), "offset_mm": offset_mm}


HARD_EYES["strong keratoconus"] = _keratoconus()


@pytest.mark.parametrize("name", HARD_EYES)
@pytest.mark.parametrize(("h_deg", "v_deg"), [(0.0, 0.0), (45.0, 0.0), (-45.0, 26.0)])
def test_hard_cases_stay_finite_or_say_why_not(name, h_deg, v_deg):
    eye = navarro(REFERENCE)
    front = replace(eye.surfaces[0], **HARD_EYES[name])
    found = wavefront_aberrations(
        replace(eye, surfaces=(front, *eye.surfaces[1:])),
        wavelength_nm=555.0,
        stop_diameter_mm=7.0,
        h_deg=h_deg,
        v_deg=v_deg,
    )
    if found.notes:
        assert found.open_ratio < 1.0
        assert found.worst_status != RayStatus.TRACED
    assert np.all(np.isfinite(found.zernike_um)) == (found.open_ratio > 0.0)


def test_the_reference_eye_passes_7_mm_at_45_deg_whole():
    found = wavefront_aberrations(
        navarro(REFERENCE), wavelength_nm=555.0, stop_diameter_mm=7.0, h_deg=45.0
    )
    assert found.notes == ()
    assert np.all(np.isfinite(found.zernike_um))


def test_a_lost_chief_ray_is_a_status():
    """A posterior cornea so small that oblique light to the stop's center misses it."""
    eye = navarro(REFERENCE)
    back = replace(eye.surfaces[1], clear_radius_mm=1.0)
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 4.0}
    eye = replace(eye, surfaces=(eye.surfaces[0], back, *eye.surfaces[2:]))
    found = wavefront_aberrations(eye, h_deg=50.0, **view)
    assert found.chief_status == RayStatus.CLIPPED
    assert found.notes == ("no chief ray: outside a clear radius",)
    assert np.all(np.isnan(found.zernike_um))
    assert found.open_ratio == 0.0


def test_zero_astigmatism_is_no_special_case():
    """Biconic and conic code agree where both radii are the same to rounding."""
    eye = navarro(REFERENCE)
    front = eye.surfaces[0]
    almost = replace(front, radius_mm=(front.radius_mm[0], front.radius_mm[0] + 1e-13))
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 5.0, "h_deg": 15.0}
    one = wavefront_aberrations(eye, **view)
    other = wavefront_aberrations(
        replace(eye, surfaces=(almost, *eye.surfaces[1:])), **view
    )
    assert np.abs(one.zernike_um - other.zernike_um).max() < 1e-9


def test_the_axis_is_no_special_case():
    """Fields that shrink to zero tend to the axial coefficients."""
    eye = irregular_eye()
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 4.0}
    axial = wavefront_aberrations(eye, **view)
    near = wavefront_aberrations(eye, h_deg=1e-7, v_deg=-1e-7, **view)
    assert np.abs(axial.zernike_um - near.zernike_um).max() < 1e-6
