"""What a profile says is worn, and what it may not say."""

import numpy as np
import pytest

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.rings import DiffractiveRings, RefractiveZones
from estimator.optics.prescription import (
    Prescription,
    power_vector,
    power_vectors_dpt,
)
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import ProfileError, parse_profile

IOL = {"kind": "iol"}
TRIFOCAL = IOL | {"design": "trifocal", "adds_dpt": [1.66, 3.33]}
ZONES = IOL | {"design": "zones"}
SOFT = {"kind": "contact_lens", "sphere_dpt": -3}


def wearing(correction, **more):
    profile = {"kind": "prescription", "sphere_dpt": 0.0, "correction": correction}
    return parse_profile(profile | more)


def test_a_correction_without_a_kind_is_spectacles():
    bare = {"sphere_dpt": -3.0, "cylinder_dpt": -1.0, "axis_deg": 20, "vertex_mm": 12}
    assert wearing(bare).correction == Prescription(-3.0, -1.0, 20.0, 12.0)
    assert wearing(bare | {"kind": "spectacles"}).correction == wearing(bare).correction


def test_a_contact_lens_acts_as_spectacles_at_the_cornea_do():
    powers = {"sphere_dpt": -4.0, "cylinder_dpt": -1.5, "axis_deg": 70}
    eyes = [
        MeasuredWavefront.from_profile(wearing(body, sphere_dpt=-4.0))
        for body in (powers, powers | {"kind": "contact_lens"})
    ]
    assert np.array_equal(eyes[0].zernike_um, eyes[1].zernike_um)
    assert eyes[0].vergence == eyes[1].vergence


def test_a_lens_turns_its_axis_as_the_examiner_sees_it():
    lens = {
        "kind": "contact_lens",
        "sphere_dpt": 0,
        "cylinder_dpt": -2,
        "axis_deg": 170,
    }
    turned = wearing(lens | {"rotation_deg": 25}).correction
    assert turned.axis_deg == 15.0
    assert wearing(lens | {"rotation_deg": -25}).correction.axis_deg == 145.0


def test_an_eye_with_an_intraocular_lens_neither_accommodates_nor_has_its_own():
    profile = wearing(IOL, age_years=20)
    eye = MeasuredWavefront.from_profile(profile)
    assert profile.higher_order == "none"
    assert eye.amplitude_dpt == 0.0
    assert eye.reachable_focus_dpt(4.0, pupil_diameter_mm=4.0) == pytest.approx(0.0)
    with pytest.raises(ProfileError, match="natural lens"):
        wearing(IOL, higher_order="typical")


def test_designs_have_the_rings_that_they_name():
    bifocal = wearing(IOL | {"design": "bifocal", "add_dpt": 3.0}).correction.rings
    assert bifocal.orders == (0, 1)
    assert bifocal.spacing_dpt == pytest.approx(
        3.0 * (1 - 0.0046 / 1.3386 * 43.04) ** 2
    )
    edof = wearing(IOL | {"design": "edof", "add_dpt": 1.75}).correction.rings
    assert (edof.orders, edof.far_order) == ((1, 2), 1)
    light = TRIFOCAL | {"adds_dpt": [2.17, 3.25], "light_ratio": [0.44, 0.22, 0.22]}
    assert wearing(light).correction.rings.orders == (0, 3)
    assert isinstance(wearing(light).correction.rings, DiffractiveRings)
    zones = ZONES | {"zone_adds_dpt": [2, 0], "zone_diameters_mm": [1.5, 6]}
    assert isinstance(wearing(zones).correction.rings, RefractiveZones)
    assert wearing(IOL).correction.rings is None


def test_zones_of_a_contact_lens_act_as_its_powers_do():
    adds_dpt, diameters_mm = [0.0, 2.0, 0.0], [3.36, 4.78, 6.75]
    zones = {"zone_adds_dpt": adds_dpt, "zone_diameters_mm": diameters_mm}
    bare = {"kind": "contact_lens", "sphere_dpt": -8.0}
    rings = wearing(bare | zones).correction.rings
    added_dpt = -6 / 1.0183 + 8 / 1.0244  # F / (1 - L F) with and without the addition
    assert rings.powers_dpt == pytest.approx([0.0, added_dpt, 0.0])
    # light that a lens of -8 dpt spreads is wider in the pupil, 3.05 mm behind it
    assert rings.outer_mm == pytest.approx(np.array(diameters_mm) / 2 * 1.0244)


def test_a_tear_film_leaves_the_sphere_and_a_ninth_of_the_rest():
    body = {"kind": "preset", "name": "keratoconus"}
    lens = {"kind": "contact_lens", "sphere_dpt": -2.5}
    soft = parse_profile(body | {"correction": lens})
    rigid = parse_profile(body | {"correction": lens | {"rigid": True}})
    left = np.full(28, 0.04 / 0.376)  # indices of cornea, tears and air
    left[4] = 1.0
    assert rigid.zernike_um == pytest.approx(soft.zernike_um * left)
    assert rigid.correction.sphere_dpt == soft.correction.sphere_dpt
    assert [note.code for note in rigid.notes if note not in soft.notes] == [
        "rigid_lens"
    ]
    toric = wearing(lens | {"rigid": True}, cylinder_dpt=-2.0, axis_deg=30)
    m_dpt, *astigmatism_dpt = power_vectors_dpt(toric.zernike_um, 3.0)
    assert m_dpt == pytest.approx(-1.0)
    assert 2.0 * np.hypot(*astigmatism_dpt) == pytest.approx(2.0 * 0.04 / 0.376)
    eye = {"kind": "published", "name": "arizona"}
    with pytest.raises(ProfileError, match="given by its published"):
        parse_profile(eye | {"correction": lens | {"rigid": True}})


def test_a_progressive_lens_is_what_the_gaze_goes_through():
    body = {"kind": "progressive", "sphere_dpt": -2, "vertex_mm": 12, "add_dpt": 2.0}
    ahead = wearing(body).correction
    down = wearing(body | {"gaze_deg": [0, -35]}).correction
    assert isinstance(ahead, ProgressiveLens)
    assert ahead.sphere_dpt == pytest.approx(-2.0, abs=0.05)
    assert power_vector(down)[0] == pytest.approx(0.0, abs=0.02)
    assert ahead.with_gaze_offset((0.0, -35.0)) == down


def test_lenslets_have_the_room_that_their_number_leaves():
    lens = wearing({"kind": "lenslets", "sphere_dpt": -3, "vertex_mm": 12}).correction
    assert power_vector(lens)[0] == pytest.approx(-3.0 / 1.036)
    cell_mm2 = lens.rings.pitch_mm**2 * np.sqrt(3.0) / 2.0
    zone_mm2 = np.pi * (lens.rings.outer_mm**2 - lens.rings.inner_mm**2)
    assert zone_mm2 / cell_mm2 == pytest.approx(396)
    turned = lens.with_gaze_offset((0.0, -25.0)).rings.seen_from(
        [0.0, 10.0], [0.0, 0.0]
    )
    x, y = np.transpose(turned.centre_mm)
    assert y == pytest.approx(25.5 * np.tan(np.radians(25.0)))
    assert x == pytest.approx([0.0, -15.05 * np.tan(np.radians(10.0))])


@pytest.mark.parametrize(
    ("correction", "field"),
    [
        ({"kind": "monocle"}, "correction.kind"),
        ({"kind": "contact_lens"}, "correction.sphere_dpt"),
        (
            {"kind": "contact_lens", "sphere_dpt": 1, "vertex_mm": 3},
            "correction.vertex_mm",
        ),
        (
            {"kind": "contact_lens", "sphere_dpt": 1, "decentration_mm": [1]},
            "correction.decentration_mm",
        ),
        (
            {"kind": "contact_lens", "sphere_dpt": 1, "decentration_mm": [0, 9]},
            "correction.decentration_mm.1",
        ),
        ({"sphere_dpt": 1, "add_dpt": 2}, "correction.add_dpt"),
        (IOL | {"design": "quintfocal"}, "correction.design"),
        (IOL | {"cylinder_dpt": 1}, "correction.axis_deg"),
        (IOL | {"add_dpt": 3}, "correction.add_dpt"),
        (IOL | {"design": "bifocal"}, "correction.add_dpt"),
        (
            IOL | {"design": "bifocal", "add_dpt": 3, "light_ratio": [0.7, 0.6]},
            "correction.light_ratio",
        ),
        (
            IOL
            | {
                "design": "bifocal",
                "add_dpt": 3,
                "light_ratio": [0.4, 0.4],
                "step_waves": 0.5,
            },
            "correction.step_waves",
        ),
        (TRIFOCAL, "correction.steps_waves"),
        (TRIFOCAL | {"adds_dpt": [3, 2]}, "correction.adds_dpt"),
        (
            TRIFOCAL | {"adds_dpt": [1.3, 3.0], "light_ratio": [0.4, 0.2, 0.2]},
            "correction.adds_dpt",
        ),
        (TRIFOCAL | {"adds_dpt": [2.0, 3.0]}, "correction.light_ratio"),
        (
            ZONES | {"zone_adds_dpt": [0, 2], "zone_diameters_mm": [3, 2]},
            "correction.zone_diameters_mm",
        ),
        (SOFT | {"zone_adds_dpt": [0, 2]}, "correction.zone_diameters_mm"),
        (SOFT | {"zone_diameters_mm": [3]}, "correction.zone_diameters_mm"),
        (
            SOFT | {"zone_adds_dpt": [0, 2], "zone_diameters_mm": [3, 13]},
            "correction.zone_diameters_mm.1",
        ),
        ({"kind": "progressive", "sphere_dpt": 0}, "correction.add_dpt"),
        (
            {"kind": "lenslets", "sphere_dpt": 0, "lenslet_count": 2000},
            "correction.lenslet_count",
        ),
    ],
)
def test_what_is_wrong_is_named(correction, field):
    with pytest.raises(ProfileError) as error:
        wearing(correction)
    assert error.value.field == field


def test_a_measured_cornea_is_not_counted_twice():
    body = IOL | {"cornea_spherical_aberration_um": 0.2}
    measured = {
        "kind": "zernike",
        "pupil_diameter_mm": 6,
        "wavelength_nm": 555,
        "zernike_um": {"4,0": 0.25},
    }
    assert parse_profile(measured | {"correction": IOL}).correction
    with pytest.raises(ProfileError, match="include the cornea"):
        parse_profile(measured | {"correction": body})
