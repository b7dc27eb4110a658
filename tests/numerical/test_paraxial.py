"""First-order optics against independent first-order programs and traced rays."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.paraxial import cardinal_points, refraction_dpt
from estimator.optics.raytrace import trace_rays
from estimator.wavefront.aberrations import pupil_magnification
from tests.numerical.schematic_eyes import irregular_eye, navarro, reference

REFERENCE = reference()
TABLE = REFERENCE["indices"]["ESN1999_table"]

NAMES = {
    "power_dpt": "power_D",
    "cornea_power_dpt": "cornea_D",
    "lens_power_dpt": "lens_D",
    "object_focal_length_mm": "f_object_mm",
    "image_focal_length_mm": "f_image_mm",
    "object_focus_mm": "F_object_z",
    "image_focus_mm": "F_image_z",
    "object_principal_mm": "H_object_z",
    "image_principal_mm": "H_image_z",
    "object_nodal_mm": "N_object_z",
    "image_nodal_mm": "N_image_z",
    "entrance_pupil_mm": "entrance_pupil_z",
    "entrance_pupil_ratio": "entrance_pupil_mag",
    "refraction_dpt": "refraction_cornea_plane_D",
}


@pytest.mark.parametrize(
    ("key", "wavelength_nm", "indices"),
    [
        ("at_589_3_table", 589.3, TABLE["589.3"]),
        ("at_543_table", 543.0, TABLE["543.0"]),
        ("at_555_herzberger", 555.0, None),
    ],
)
def test_cardinal_points_match_the_reference(key, wavelength_nm, indices):
    eye = navarro(REFERENCE, indices=indices)
    found = cardinal_points(eye, wavelength_nm=wavelength_nm)
    for name, given in NAMES.items():
        # the issue asks for 1e-5; both are closed forms
        assert abs(getattr(found, name) - REFERENCE["paraxial"][key][given]) < 1e-10


def test_chromatic_focus_matches_the_table():
    focus_mm = cardinal_points(navarro(REFERENCE), wavelength_nm=589.3).image_focus_mm
    eye = navarro(REFERENCE, retina_z_mm=focus_mm)
    for wavelength_nm, expected_dpt, _ in REFERENCE["lca"]["rows"]:
        found_dpt = refraction_dpt(eye, wavelength_nm=wavelength_nm)
        assert abs(found_dpt - expected_dpt) < 2e-3, wavelength_nm


def test_traced_light_near_the_axis_agrees():
    """Offsets of second order and the retina's refraction, by real rays at 1 um."""
    eye = irregular_eye()
    straight = tuple(
        replace(s, tilt_deg=(0.0, 0.0), decentration_mm=(0.0, 0.0), rotation_deg=0.0)
        for s in eye.surfaces
    )
    offset_mm = np.zeros(28)
    offset_mm[4] = 0.03
    cornea = replace(straight[0], radius_mm=(7.7, 7.7), offset_mm=offset_mm)
    round_ = tuple(replace(s, radius_mm=(s.radius_mm[0],) * 2) for s in straight[1:])
    eye = replace(eye, surfaces=(cornea, *round_))
    height_mm = 1e-3
    traced = trace_rays(
        eye,
        start_mm=(height_mm, 0.0, -5.0),
        direction=(0.0, 0.0, 1.0),
        wavelength_nm=555.0,
    )
    point, direction = traced.points_mm[0, -2], traced.direction_ratio[0, -2]
    focus_mm = point[2] - point[0] * direction[2] / direction[0]
    found = cardinal_points(eye, wavelength_nm=555.0)
    assert abs(focus_mm - found.image_focus_mm) < 1e-6
    stop_height_mm = traced.points_mm[0, traced.stop_index, 0]
    # second order in the height: 1e-3² over squared radii
    assert abs(height_mm / stop_height_mm - found.entrance_pupil_ratio) < 1e-6


def test_entrance_pupil_of_real_rays_is_the_paraxial_one():
    eye = navarro(REFERENCE)
    ratio = cardinal_points(eye, wavelength_nm=555.0).entrance_pupil_ratio
    assert abs(pupil_magnification(eye) - ratio) < 1e-7


def test_entrance_pupil_of_an_astigmatic_cornea_is_the_mean_of_its_meridians():
    eye = navarro(REFERENCE)

    def ratio(rx_mm, ry_mm):
        cornea = replace(eye.surfaces[0], radius_mm=(rx_mm, ry_mm))
        return pupil_magnification(replace(eye, surfaces=(cornea, *eye.surfaces[1:])))

    geometric = math.sqrt(ratio(7.4, 7.4) * ratio(8.0, 8.0))
    assert abs(ratio(7.4, 8.0) - geometric) < 1e-7
