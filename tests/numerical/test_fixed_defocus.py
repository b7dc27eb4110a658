"""Total defocus of fixed fields by a compiled loop, against that of wavefronts."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.zernike import MAX_TERMS, monomial_degrees, padded_terms
from tests.numerical.plan_cases import spec_for, traced_eye

WIDE = {
    "mode": "dynamic",
    "pupil_range_mm": (1.5, 8.0),
    "focus_range_dpt": (0.0, 4.0),
}


@pytest.mark.long("an eye is traced over its widest ranges")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("emmetropia", marks=pytest.mark.slow),
        "keratoconus",
        pytest.param("cataract", marks=pytest.mark.slow),
    ],
)
def test_defocus_equals_that_of_the_wavefronts(name, rng):
    """Through small, whole and cut-off pupils, relaxed and accommodating."""
    spec = spec_for(320, 180, **WIDE)
    eye = traced_eye(name, spec)
    (left, right), (down, up) = spec.field_range_deg
    h_deg, v_deg = rng.uniform(left, right, 40), rng.uniform(down, up, 40)
    fields = {"h_deg": h_deg, "v_deg": v_deg}
    fields["wavelength_nm"] = np.resize(spec.channel_wavelengths_nm, 40)
    at_state = eye.defocus_at(**fields)
    largest_mm = min(8.0, eye.max_pupil_diameter_mm)
    last_dpt = float(eye.grid.accommodations_dpt[-1])
    for pupil_mm in (1.5, *rng.uniform(1.5, largest_mm, 6), largest_mm):
        for used_dpt in (0.0, 0.37 * last_dpt, last_dpt):
            state = {"pupil_diameter_mm": pupil_mm, "accommodation_dpt": used_dpt}
            np.testing.assert_allclose(
                at_state(**state),
                eye.total_defocus_dpt(**fields, **state),
                rtol=1e-10,
                atol=1e-11,
            )


def test_a_residual_of_tenth_order_counts_in_small_and_stretched_pupils(rng):
    eye = copy.copy(traced_eye("keratoconus", spec_for(320, 180, **WIDE)))
    plain = eye.defocus_at(h_deg=[3.0], v_deg=[2.0], wavelength_nm=[536.0])
    residual = eye._residual
    added_um = (
        0.3
        * rng.normal(size=MAX_TERMS)
        / residual.radius_mm ** (monomial_degrees(MAX_TERMS))
    )
    eye._residual = replace(
        residual, residue_um=padded_terms(residual.residue_um, MAX_TERMS) + added_um
    )
    fields = {"h_deg": [3.0], "v_deg": [2.0], "wavelength_nm": [536.0]}
    at_state = eye.defocus_at(**fields)
    for pupil_mm in (2.0, 5.0, eye.max_pupil_diameter_mm):
        state = {"pupil_diameter_mm": pupil_mm, "accommodation_dpt": 0.0}
        whole_dpt = eye.total_defocus_dpt(**fields, **state)
        found = eye.wavefronts(**fields, **state, total_defocus_dpt=whole_dpt)
        assert found.zernike_um.shape == (1, MAX_TERMS)
        assert np.abs(found.zernike_um[:, 28:]).max() > 1e-9
        assert at_state(**state) == pytest.approx(whole_dpt, rel=1e-10, abs=1e-11)
        assert abs(at_state(**state) - plain(**state)) > 1e-3


def test_a_state_that_was_not_traced_is_refused():
    spec = spec_for(320, 180, **WIDE)
    eye = traced_eye("keratoconus", spec)
    at_state = eye.defocus_at(h_deg=[0.0], v_deg=[0.0], wavelength_nm=[536.0])
    with pytest.raises(ValueError, match="pupil_diameter_mm 12 to 12: traced are"):
        at_state(pupil_diameter_mm=12.0, accommodation_dpt=0.0)
