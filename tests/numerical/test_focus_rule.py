"""Focus: a traced eye focuses a distance where its wavefront has the smallest RMS.

The light of each pupil is traced for its own accommodation, without any table or
interpolation, and fitted by least squares at points inside the pupil.
"""

import numpy as np
import pytest

from estimator.estimate.model import eye_model
from estimator.eye.focusing import OUT_OF_REACH_DPT
from estimator.field.prepare import prepare_eye
from estimator.optics.zernike import exponents
from estimator.profiles.parse import parse_profile
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import (
    circumscribed_radius_mm,
    polynomial_in_mm,
    rim_from_ellipse,
)

LIMIT_DPT = 0.01
FOCI_DPT = (0.5, 3.0, 6.0)
RESIDUAL = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"2,0": 0.0, "4,0": 0.5, "4,-4": 0.5, "6,0": 0.2, "6,6": 0.25},
}
"""Wavefront that no eye of 45 parameters has: a third of it is residual."""


def points_mm(ellipse_mm, radius_mm):
    """Return points (n, 2) that fill a pupil whose circumscribed circle is given."""
    rim = rim_from_ellipse(ellipse_mm)
    x, y, xx, xy, yy = rim * radius_mm / circumscribed_radius_mm(rim)
    unit = (np.stack(np.meshgrid(*2 * [np.arange(-60, 61)]), -1) / 60.5).reshape(-1, 2)
    px, py = unit[np.hypot(*unit.T) <= 1.0].T
    return x + xx * px + xy * py, y + xy * px + yy * py


def defocus_dpt(model, residual, *, pupil_mm, accommodation_dpt):
    """Return the traced least-squares M over the light of a pupil."""
    (state,) = model.accommodating.states_at([accommodation_dpt])
    found = wavefront_grid(
        state.surfaces,
        fields_deg=[[0.0, 0.0]],
        wavelengths_nm=[555.0],
        pupil_diameters_mm=[pupil_mm],
        plane="pupil",
    )
    assert found.open_ratio.min() > 0.999
    wave_um = polynomial_in_mm(found.zernike_um, found.zernike_radius_mm).ravel()
    own_um = residual.on_axis_um(pupil_mm)[0]
    powers = exponents(max(wave_um.size, own_um.size))
    wave_um = np.pad(wave_um, (0, len(powers) - wave_um.size))
    wave_um += np.pad(own_um, (0, len(powers) - own_um.size))
    x, y = points_mm(found.ellipse_mm.ravel(), pupil_mm / 2.0)
    of_x, of_y = (np.vander(v, powers.max() + 1, increasing=True) for v in (x, y))
    values_um = (of_x[:, powers[:, 0]] * of_y[:, powers[:, 1]]) @ wave_um
    columns = np.stack([np.ones_like(x), x, y, x**2 + y**2], axis=-1)
    return -2.0 * np.linalg.lstsq(columns, values_um)[0][3]


@pytest.mark.parametrize(
    ("body", "pupils_mm"),
    [
        ({"kind": "preset", "name": "emmetropia"}, (2.5, 6.5)),
        ({"kind": "preset", "name": "keratoconus"}, (3.5, 6.5)),
        ({"kind": "preset", "name": "cataract"}, (3.5, 5.0, 6.0, 7.0)),
        ({"kind": "preset", "name": "post_lasik"}, (4.5, 7.0)),
        (RESIDUAL, (4.5, 5.5, 6.5)),
    ],
    ids=["emmetropia", "keratoconus", "cataract", "post_lasik", "residual"],
)
def test_a_focus_in_reach_has_no_defocus_over_the_pupil(body, pupils_mm):
    profile = parse_profile(body)
    eye, _ = prepare_eye(
        profile, pupil_diameters_mm=pupils_mm, focus_range_dpt=(0.0, 6.0)
    )
    model, tested = eye_model(profile), 0
    residual = model.rest(555.0)
    for pupil_mm in pupils_mm:
        for focus_dpt in FOCI_DPT:
            if eye.notes(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt):
                continue  # out of reach, and reported
            accommodation_dpt = eye.accommodation_dpt(
                focus_dpt, pupil_diameter_mm=pupil_mm
            )
            found_dpt = defocus_dpt(
                model,
                residual,
                pupil_mm=pupil_mm,
                accommodation_dpt=accommodation_dpt,
            )
            # a relaxed eye may be beyond reach by what needs no note
            beyond_dpt = OUT_OF_REACH_DPT if accommodation_dpt == 0.0 else 0.0
            assert found_dpt == pytest.approx(-focus_dpt, abs=LIMIT_DPT + beyond_dpt)
            tested += 1
    assert tested >= len(pupils_mm)


def test_the_far_point_in_a_note_is_that_of_the_pupil():
    """Light does not fill 6 mm of the cataract preset in its most curved states."""
    profile = parse_profile({"kind": "preset", "name": "cataract"})
    model = eye_model(profile)
    for pupil_mm in (5.0, 6.0, 7.0):
        traced_dpt = defocus_dpt(
            model, model.rest(555.0), pupil_mm=pupil_mm, accommodation_dpt=0.0
        )
        (note,) = model.accommodating.focus_notes(0.0, pupil_diameter_mm=pupil_mm)
        _, _, far = note.partition("beyond the far point (")
        assert float(far.split()[0]) == pytest.approx(-traced_dpt, abs=2 * LIMIT_DPT)
