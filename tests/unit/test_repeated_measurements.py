"""Measurements of one direction: repeats are averaged, contradictions refused."""

import numpy as np
import pytest

from estimator import ProfileError, parse_profile
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.vergence import chromatic_refraction_dpt


def measured(h_deg, zernike_um, pupil_diameter_mm=5.0, wavelength_nm=555.0):
    return {
        "h_deg": h_deg,
        "v_deg": 0.0,
        "pupil_diameter_mm": pupil_diameter_mm,
        "wavelength_nm": wavelength_nm,
        "zernike_um": zernike_um,
    }


def read(*measurements):
    return parse_profile({"kind": "zernike_set", "measurements": list(measurements)})


@pytest.mark.parametrize("h_deg", [0.0, 20.0])
def test_repeats_are_averaged_with_a_note(h_deg):
    axis = [] if h_deg == 0.0 else [measured(0.0, {"2,0": 1.0})]
    low, high = {"2,0": 1.0, "3,1": 0.1}, {"2,0": 1.2, "3,1": 0.2}
    profile = read(*axis, measured(h_deg, low), measured(h_deg + 0.3, high))
    *_, mean = profile.measurements
    assert len(profile.measurements) == len(axis) + 1
    assert (mean.zernike_um[4], mean.h_deg) == (pytest.approx(1.1), h_deg)
    assert mean.zernike_um[8] == pytest.approx(0.15)
    (note,) = profile.notes
    assert (note.code, note.values["measurement_count"]) == ("repeated_measurements", 2)


def test_repeats_of_different_orders_are_averaged():
    low, high = {"2,0": 1.0}, {"2,0": 1.2, "8,0": 0.1}
    profile = read(measured(0.0, low), measured(0.0, high))
    (mean,) = profile.measurements
    assert mean.zernike_um.shape == (45,)
    assert mean.zernike_um[[4, 40]] == pytest.approx([1.1, 0.05])


@pytest.mark.parametrize(
    ("measurements", "name"),
    [
        ([measured(0.0, {"2,0": 1.0}), measured(0.0, {"2,0": 2.0})], "1"),
        (
            [
                measured(h, {"2,0": c})
                for h, c in ((0.0, 0.0), (20.0, 2.0), (20.0, -2.0))
            ],
            "2",
        ),
        ([measured(0.0, {"3,-1": 0.4}), measured(0.0, {"3,-1": 0.0})], "1"),
        ([measured(0.0, {"2,0": 1.0}), measured(0.0, {"2,0": 1.0}, 3.0)], "1"),
        ([measured(0.0, {"2,0": 1.0, "8,0": 0.4}), measured(0.0, {"2,0": 1.0})], "1"),
    ],
)
def test_contradictions_are_refused_by_name(measurements, name):
    with pytest.raises(ProfileError, match="contradicts measurement") as caught:
        read(*measurements)
    assert caught.value.field == f"measurements.{name}.zernike_um"


def test_other_pupils_and_wavelengths_of_one_wavefront_are_kept():
    """A sphere has C(2,0) proportional to the square of the pupil; color changes it."""
    color_dpt = chromatic_refraction_dpt(850.0) - chromatic_refraction_dpt(555.0)
    infrared_um = 1.0 - color_dpt * 2.5**2 / SPHERE_PER_C20
    profile = read(
        measured(0.0, {"2,0": 1.0}),
        measured(0.0, {"2,0": 0.36}, 3.0),
        measured(0.0, {"2,0": float(infrared_um)}, 5.0, 850.0),
    )
    assert [m.pupil_diameter_mm for m in profile.measurements] == [5.0, 3.0, 5.0]
    np.testing.assert_allclose(
        [m.zernike_um[4] for m in profile.measurements], [1.0, 0.36, infrared_um]
    )
    assert profile.notes == ()
