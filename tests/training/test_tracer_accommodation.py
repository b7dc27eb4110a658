"""Focusing batches of eyes against the accommodating eye of the estimator."""

import numpy as np
import pytest

from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import accommodated_vectors
from estimator.eye.parameters import EyeParameters, column, mean_vector, random_vectors

torch = pytest.importorskip("torch")

from training.tracer.accommodation import accommodated_eyes, focus_of_eyes  # noqa: E402

N_EYES, N_FOCUSES = 40, 6


def test_eyes_accommodate_as_the_estimators(rng):
    vector = random_vectors(1, rng)[0]
    diameters_mm = vector[column("lens_diameter_mm")] * np.linspace(0.84, 1.0, 5)
    truth = accommodated_vectors(vector, lens_diameter_mm=diameters_mm)
    found = accommodated_eyes(
        torch.tensor(vector).expand(5, -1), torch.tensor(diameters_mm)
    )
    np.testing.assert_allclose(found.numpy(), truth, atol=1e-13)


def test_focuses_are_those_of_the_accommodating_eye(rng):
    vectors = random_vectors(N_EYES, rng)
    pupil_mm = rng.uniform(2.0, 7.0, N_EYES)
    focus_dpt = rng.uniform(0.0, 9.0, (N_EYES, N_FOCUSES))
    truth_mm = np.empty((N_EYES, N_FOCUSES, 2))
    share = []
    for i, vector in enumerate(vectors):
        eye = AccommodatingEye(
            EyeParameters.from_vector(vector), pupil_diameter_mm=pupil_mm[i]
        )
        # The networks speak of refraction at the cornea.
        used_dpt = eye.accommodations_at_cornea_dpt(-focus_dpt[i])
        truth_mm[i] = eye.changes_mm(used_dpt)
        share.extend(used_dpt / eye.amplitude_dpt)
    # The eyes drawn stay relaxed, reach their focus, and come to their end.
    assert min(share) == 0.0
    assert max(share) == 1.0
    assert np.mean((np.array(share) > 0.0) & (np.array(share) < 1.0)) > 0.3
    eyes = (torch.tensor(vectors), torch.tensor(pupil_mm))
    found = focus_of_eyes(*eyes, torch.tensor(focus_dpt))
    assert bool(found.ok.all())
    np.testing.assert_allclose(
        torch.stack(found[:2], -1).numpy(), truth_mm, atol=1e-6, rtol=0.0
    )
    narrow = focus_of_eyes(*eyes, torch.tensor(focus_dpt), ray_dtype=torch.float32)
    assert narrow.lens_diameter_change_mm.dtype == torch.float32
    np.testing.assert_allclose(
        torch.stack(narrow[:2], -1).numpy(), truth_mm, atol=1e-4, rtol=0.0
    )
    single = focus_of_eyes(*eyes, torch.tensor(focus_dpt[:, 0]))
    assert single.ok.shape == (N_EYES,)
    np.testing.assert_allclose(
        single.lens_diameter_change_mm.numpy(), truth_mm[:, 0, 0], atol=1e-6, rtol=0.0
    )


def test_an_eye_that_light_does_not_pass_is_not_ok():
    vectors = np.repeat(mean_vector()[None], 2, axis=0)
    vectors[1, column("cornea_anterior_radius_mm")] = 2.5
    found = focus_of_eyes(
        torch.tensor(vectors),
        torch.tensor([6.0, 6.0], dtype=torch.float64),
        torch.tensor([[0.0, 3.0]] * 2, dtype=torch.float64),
    )
    assert found.ok.tolist() == [[True, True], [False, False]]
    assert bool(torch.isnan(found.lens_diameter_change_mm[1]).all())
    assert bool(torch.isfinite(found.aqueous_thickness_change_mm[0]).all())
