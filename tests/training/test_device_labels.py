"""Labels by the tracer in torch are those of the domains."""

import numpy as np
import pytest
import torch

from training.datasets import Recipe, draw
from training.device_labels import label_on_device
from training.tasks import DOMAINS


@pytest.mark.parametrize(
    ("name", "n_rows", "tolerance"),
    [
        ("on_axis", 40, 1e-6),
        ("field", 40, 1e-6),
        ("focus", 80, 1e-5),
        ("lens", 40, 1e-5),
    ],
)
def test_labels_on_a_device_are_those_of_the_domain(name, n_rows, tolerance):
    domain = DOMAINS[name]
    inputs = draw(Recipe(name, n_rows, n_rows, seed=11), 0)
    found = label_on_device(domain, inputs, torch.device("cpu"))
    wanted = domain.label(inputs)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    np.testing.assert_allclose(found, wanted, atol=tolerance)
    assert np.isfinite(wanted).mean() > 0.5


def test_a_lens_that_only_a_part_of_the_light_passes_is_no_row():
    inputs = draw(Recipe("lens", 3000, 3000, 4, "random", population_ratio=1.0), 0)
    wanted = DOMAINS["lens"].label(inputs)
    lost = np.flatnonzero(np.isnan(wanted[:, 0]))
    assert 1 <= len(lost) < 60
    chosen = inputs[np.r_[lost, lost + 1]]
    found = label_on_device(DOMAINS["lens"], chosen, torch.device("cpu"))
    expected = np.isnan(wanted[np.r_[lost, lost + 1]])
    np.testing.assert_array_equal(np.isnan(found[:, 0]), expected[:, 0])
