"""The published statistics: reproduced with the published labels, not with ours."""

import numpy as np
import pytest

from estimator.optics.zernike import zernike_gradient
from training.datasets import Recipe, draw
from training.published_labels import (
    FIELD_STEPS,
    ON_AXIS_STEPS,
    label_field_as_published,
    label_on_axis_as_published,
    lens_search_as_published,
    narrow_posterior_conic,
    stretched,
)
from training.statistics import PUBLISHED, ROWS, group_statistics
from training.tasks import DOMAINS

N_EYES = 2048


def _statistics(name, targets):
    good = targets[np.all(np.isfinite(targets), axis=1)]
    found = group_statistics(DOMAINS[name], good)
    return {g: dict(zip(ROWS, v, strict=True)) for g, v in found.items()}


def _published(name):
    return {g: dict(zip(ROWS, v, strict=True)) for g, v in PUBLISHED[name].items()}


def test_the_published_labels_explain_the_published_spread_on_axis():
    inputs = draw(Recipe("on_axis", N_EYES, N_EYES), 0)
    ours = _statistics("on_axis", DOMAINS["on_axis"].label(inputs))
    chain = label_on_axis_as_published(narrow_posterior_conic(inputs), ON_AXIS_STEPS)
    theirs, wanted = _statistics("on_axis", chain), _published("on_axis")
    for group, tolerance in (("n=1,2", 0.03), ("n=3,4", 0.06)):
        assert theirs[group]["std"] == pytest.approx(
            wanted[group]["std"], rel=tolerance
        )
        assert ours[group]["std"] < 0.8 * wanted[group]["std"]


def test_the_published_stretch_explains_the_published_spread_of_the_field():
    inputs = narrow_posterior_conic(draw(Recipe("field", N_EYES, N_EYES), 0))
    wanted = _published("field")
    for steps, is_met in ((FIELD_STEPS, True), (FIELD_STEPS[:-1], False)):
        found = _statistics("field", label_field_as_published(inputs, steps))
        ratio = found["n=3,4"]["std"] / wanted["n=3,4"]["std"]
        assert (0.94 < ratio < 1.06) == is_met


def test_a_round_pupil_is_not_stretched():
    terms = np.random.default_rng(0).normal(size=28)
    terms[0] = 0.0
    found = stretched(terms, 2.0, np.array([0.0, 0.0, 2.0, 2.0, 0.3]))
    np.testing.assert_allclose(found, terms, atol=1e-9)


def test_the_stretch_multiplies_slopes_along_the_minor_axis():
    terms = np.zeros(28)
    terms[4] = 1.0  # defocus alone: slopes grow linearly
    ratio = 0.8
    found = stretched(terms, 2.0, np.array([0.0, 0.0, 2.0, 2.0 * ratio, 0.0]))
    slope = zernike_gradient(0.0, 0.5) @ found
    unstretched = zernike_gradient(0.0, 0.5 * ratio) @ terms
    np.testing.assert_allclose(slope[1], unstretched[1] / ratio)


def test_the_published_search_stops_at_nine_per_cent():
    inputs = draw(Recipe("focus", 400, 400), 0)
    targets = DOMAINS["focus"].label(inputs)
    bound = lens_search_as_published(inputs, targets)
    lens_mm = inputs[:, DOMAINS["focus"].inputs.index("lens_diameter_mm")]
    assert np.any(targets[:, 0] < -0.09 * lens_mm)
    assert np.all(bound[:, 0] >= -0.09 * lens_mm * (1 + 1e-12))
    free = targets[:, 0] >= -0.09 * lens_mm
    np.testing.assert_array_equal(bound[free], targets[free])
