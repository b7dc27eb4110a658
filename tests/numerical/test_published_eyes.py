"""Schematic eyes from the literature against their published figures."""

import re

import numpy as np
import pytest

from estimator.optics.gradients import GRADIENTS
from estimator.optics.paraxial import cardinal_points
from estimator.profiles.bodies import PUBLISHED_NAMES
from estimator.profiles.surfaces import published_eye
from estimator.wavefront.aberrations import wavefront_grid


@pytest.mark.parametrize("name", PUBLISHED_NAMES)
def test_figures_are_met_to_the_digits_given(name):
    eye = published_eye(name)
    found = cardinal_points(eye.surfaces, wavelength_nm=eye.wavelength_nm)
    assert eye.figures
    for figure in eye.figures:
        value = getattr(found, figure.quantity)
        assert round(value, figure.digits) == pytest.approx(figure.value), figure


@pytest.mark.parametrize("name", PUBLISHED_NAMES)
def test_every_number_has_a_retrievable_source(name):
    eye = published_eye(name)
    places = (*eye.sources, *(figure.source for figure in eye.figures))
    assert all(re.match(r"https://\S+, commit [0-9a-f]{40}: \S", p) for p in places)
    assert re.search(r"\(?(19|20)\d\d\)", eye.reference)


@pytest.mark.parametrize("name", PUBLISHED_NAMES)
def test_light_passes_over_the_field(name):
    """All rays of a 3 mm stop reach the retina up to 40 deg, at three colors."""
    found = wavefront_grid(
        published_eye(name).surfaces,
        fields_deg=[[0.0, 0.0], [20.0, 10.0], [-40.0, 0.0]],
        wavelengths_nm=[453.0, 536.0, 618.0],
        stop_diameters_mm=[3.0],
    )
    assert np.all(found.open_ratio == pytest.approx(1.0))
    assert np.all(np.isfinite(found.zernike_um))


def test_there_are_several_eyes_and_one_has_a_gradient():
    eyes = [published_eye(name) for name in PUBLISHED_NAMES]
    assert len(eyes) >= 5
    media = [m for e in eyes for m in (e.surfaces.media or {}).values()]
    assert any(isinstance(m, GRADIENTS) for m in media)


def test_an_unknown_eye_is_refused():
    with pytest.raises(ValueError, match="allowed are arizona"):
        published_eye("gullstrand")
