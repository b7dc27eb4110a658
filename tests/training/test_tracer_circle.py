"""The batched tracer on axis against the compiled one: values and gradients."""

import numpy as np
import pytest

from estimator.eye.parameters import column, mean_vector, random_vectors, sampled_ranges
from estimator.eye.tracing import zernike_of_vectors
from estimator.optics.media import refractive_index

torch = pytest.importorskip("torch")

from training.tracer.circle import zernike_of_eyes  # noqa: E402
from training.tracer.eye import refractive_indices  # noqa: E402

N_EYES = 500


def tensors(*arrays):
    return tuple(torch.tensor(np.asarray(a)) for a in arrays)


def random_eyes(rng, count):
    return (
        random_vectors(count, rng),
        rng.uniform(3.0, 6.0, count),
        rng.uniform(450.0, 900.0, count),
    )


def compiled_zernike_um(vectors, pupil_mm, wavelength_nm):
    rows = [
        zernike_of_vectors(v[None], pupil_diameter_mm=p, wavelength_nm=w)[0]
        for v, p, w in zip(vectors, pupil_mm, wavelength_nm, strict=True)
    ]
    return np.stack(rows)


def test_indices_are_those_of_the_media():
    wavelength_nm = np.linspace(365.0, 1014.0, 40)
    found = refractive_indices(torch.tensor(wavelength_nm)).numpy()
    for i, medium in enumerate(("air", "cornea", "aqueous", "lens", "vitreous")):
        np.testing.assert_allclose(
            found[:, i], refractive_index(medium, wavelength_nm), atol=1e-13
        )
    with pytest.raises(ValueError, match="allowed is 365 to 1014"):
        refractive_indices(torch.tensor([364.0]))


def test_coefficients_are_those_of_the_compiled_tracer(rng):
    eyes = random_eyes(rng, N_EYES)
    truth_um = compiled_zernike_um(*eyes)
    found_um, ok = zernike_of_eyes(*tensors(*eyes))
    assert bool(ok.all())
    assert np.abs(found_um.numpy() - truth_um).max() < 1e-8
    narrow_um, ok = zernike_of_eyes(*tensors(*eyes), ray_dtype=torch.float32)
    assert bool(ok.all())
    assert narrow_um.dtype == torch.float32
    error_um = np.abs(narrow_um.numpy() - truth_um)
    assert error_um.max() < 1e-4
    assert np.sqrt(np.mean(error_um**2)) < 1e-5


def test_parts_of_a_batch_give_what_the_whole_gives(rng):
    eyes = tensors(*random_eyes(rng, 11))
    whole_um, _ = zernike_of_eyes(*eyes, chunk=11)
    parts_um, _ = zernike_of_eyes(*eyes, chunk=3)
    np.testing.assert_allclose(parts_um.numpy(), whole_um.numpy(), atol=1e-9)
    with pytest.raises(ValueError, match="must be equal"):
        zernike_of_eyes(eyes[0], eyes[1][:5], eyes[2])


def test_gradients_are_central_differences_of_the_compiled_tracer(rng):
    vectors, pupil_mm, wavelength_nm = random_eyes(rng, 3)
    widths = np.diff(sampled_ranges())[:, 0]
    steps = 2e-3 * widths
    moves = np.array([1.0, -1.0, 2.0, -2.0])[:, None, None] * np.diag(steps)
    given = torch.tensor(vectors, requires_grad=True)
    zernike_um, _ = zernike_of_eyes(given, *tensors(pupil_mm, wavelength_nm))
    for i in range(3):
        moved_um = zernike_of_vectors(
            (vectors[i] + moves).reshape(-1, 45),
            pupil_diameter_mm=pupil_mm[i],
            wavelength_nm=wavelength_nm[i],
        ).reshape(4, 45, 28)
        near_um, far_um = moved_um[0] - moved_um[1], moved_um[2] - moved_um[3]
        truth = (8.0 * near_um - far_um) / (12.0 * steps[:, None])
        found = torch.stack(
            [
                torch.autograd.grad(zernike_um[i, j], given, retain_graph=True)[0][i]
                for j in range(28)
            ],
            dim=-1,
        ).numpy()
        error = np.abs(found - truth).max(axis=1)
        assert np.all(error < 1e-5 * np.linalg.norm(truth, axis=1))


def test_gradients_reach_the_pupil_and_the_wavelength(rng):
    vectors, pupil_mm, wavelength_nm = tensors(*random_eyes(rng, 4))
    pupil_mm.requires_grad_(True)
    wavelength_nm.requires_grad_(True)
    zernike_um, _ = zernike_of_eyes(vectors, pupil_mm, wavelength_nm)
    by_pupil, by_wavelength = torch.autograd.grad(
        zernike_um[:, 4].sum(), (pupil_mm, wavelength_nm)
    )
    for given, found, h in ((0, by_pupil, 1e-3), (1, by_wavelength, 0.5)):
        low, high = ([pupil_mm.detach(), wavelength_nm.detach()] for _ in range(2))
        low[given], high[given] = low[given] - h, high[given] + h
        change = zernike_of_eyes(vectors, *high)[0] - zernike_of_eyes(vectors, *low)[0]
        slope = change[:, 4] / (2.0 * h)
        np.testing.assert_allclose(found.numpy(), slope.numpy(), rtol=1e-5, atol=1e-9)


def test_an_eye_that_light_does_not_pass_spoils_no_other(rng):
    vectors = np.repeat(mean_vector()[None], 3, axis=0)
    # Radius 2.5 mm: a circle of 6 mm is wider than the whole cornea.
    vectors[1, column("cornea_anterior_radius_mm")] = 2.5
    given = torch.tensor(vectors, requires_grad=True)
    zernike_um, ok = zernike_of_eyes(
        given, *tensors(np.full(3, 6.0), np.full(3, 555.0))
    )
    assert ok.tolist() == [True, False, True]
    assert bool(torch.isnan(zernike_um[1]).all())
    zernike_um[ok].square().sum().backward()
    assert bool(torch.isfinite(given.grad).all())
    assert given.grad[1].abs().max() == 0.0
    assert given.grad[0].abs().max() > 0.0


def test_what_inference_has_made_may_be_trained_through(rng):
    vectors, *view = tensors(*random_eyes(rng, 2))
    with torch.inference_mode():
        judged_um, _ = zernike_of_eyes(vectors, *view)
    narrow = vectors.float().requires_grad_(True)
    zernike_um, ok = zernike_of_eyes(narrow, *(part.float() for part in view))
    assert zernike_um.dtype == torch.float32
    np.testing.assert_allclose(
        zernike_um.detach().numpy(), judged_um.numpy(), atol=2e-4
    )
    zernike_um[ok].square().sum().backward()
    assert bool(torch.isfinite(narrow.grad).all())
