"""The batched tracer over the field against the compiled one, and its fit by parts."""

import numpy as np
import pytest

from estimator.eye.assembly import pack_eyes
from estimator.eye.parameters import column, mean_vector, random_vectors, sampled_ranges
from estimator.eye.tracing import eye_indices
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import zernike_values
from estimator.wavefront.aberrations import eyes_aberrations
from estimator.wavefront.compiled import magnifications

torch = pytest.importorskip("torch")

from training.tracer.field import (  # noqa: E402
    field_aberrations_of_eyes,
    fit_zernike,
    rim_ellipse,
    rim_radius,
    zernike_basis,
)

N_ROWS = 250


def tensors(arrays):
    return tuple(torch.tensor(array) for array in arrays)


def random_rows(rng, count):
    vectors = random_vectors(count, rng)
    vectors[:, column("lens_diameter_mm")] = rng.uniform(8.4, 9.75, count)
    return (
        vectors,
        rng.uniform(2.0, 7.0, count),
        rng.uniform(450.0, 700.0, count),
        rng.uniform(-45.0, 45.0, count),
        rng.uniform(-26.0, 26.0, count),
    )


def as_matrix(ellipse_mm):
    """Center and R diag(major, minor) R^T, (..., 5), of the compiled ellipse."""
    cx, cy, major, minor, angle = np.moveaxis(ellipse_mm, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    xx, yy = major * c * c + minor * s * s, major * s * s + minor * c * c
    return np.stack([cx, cy, xx, (major - minor) * s * c, yy], axis=-1)


def compiled(vectors, pupil_mm, wavelength_nm, h_deg, v_deg):
    """Columns of 28 coefficients, radius and ellipse of eyes at one view, and ok."""
    packed, reference = pack_eyes(vectors), eye_indices(REFERENCE_WAVELENGTH_NM)
    ratios = magnifications(packed, reference)
    found = eyes_aberrations(
        packed,
        eye_indices(wavelength_nm),
        stop_diameters_mm=pupil_mm / ratios,
        h_deg=h_deg,
        v_deg=v_deg,
    )
    columns = (
        found.zernike_um,
        found.zernike_radius_mm[:, None],
        as_matrix(found.ellipse_mm),
    )
    return np.concatenate(columns, axis=1), found.worst_status_index == 0


def compiled_rows(rows):
    found = [compiled(v[None], *view) for v, *view in zip(*rows, strict=True)]
    values, ok = zip(*found, strict=True)
    return np.concatenate(values), np.concatenate(ok)


def columns_of(found):
    return torch.cat(
        [found.zernike_um, found.zernike_radius_mm[:, None], found.ellipse_mm], dim=1
    )


def test_wavefronts_are_those_of_the_compiled_tracer(rng):
    rows = random_rows(rng, N_ROWS)
    truth, whole = compiled_rows(rows)
    assert whole.all()
    found = field_aberrations_of_eyes(*tensors(rows))
    assert bool(found.ok.all())
    error = np.abs(columns_of(found).numpy() - truth)
    assert error[:, :28].max() < 2e-7
    assert error[:, 28].max() < 2e-8
    assert error[:, 29:].max() < 1e-8
    narrow = field_aberrations_of_eyes(*tensors(rows), ray_dtype=torch.float32)
    assert bool(narrow.ok.all())
    error = np.abs(columns_of(narrow).numpy() - truth)
    assert error[:, :28].max() < 2e-3
    assert np.sqrt(np.mean(error[:, :28] ** 2)) < 1e-4
    assert error[:, 28:].max() < 2e-5


def test_vignetted_rows_are_the_compiled_tracers(rng):
    rows = list(random_rows(rng, 60))
    rows[1] = rng.uniform(5.0, 8.0, 60)
    rows[3] = rng.uniform(55.0, 74.0, 60)
    _, whole = compiled_rows(rows)
    found = field_aberrations_of_eyes(*tensors(rows))
    assert 0.1 < whole.mean() < 0.9
    assert found.ok.tolist() == whole.tolist()
    assert bool(torch.isnan(found.zernike_um[~found.ok]).all())
    assert bool(torch.isfinite(columns_of(found)[found.ok]).all())


def test_gradients_are_central_differences_of_the_compiled_tracer(rng):
    rows = random_rows(rng, 2)
    steps = 2e-3 * np.diff(sampled_ranges())[:, 0]
    moves = np.array([1.0, -1.0, 2.0, -2.0])[:, None, None] * np.diag(steps)
    given, *views = tensors(rows)
    given.requires_grad_(True)
    columns = columns_of(field_aberrations_of_eyes(given, *views))
    for i, (vector, *view) in enumerate(zip(*rows, strict=True)):
        moved, _ = compiled((vector + moves).reshape(-1, 45), *view)
        moved = moved.reshape(4, 45, -1)
        near, far = moved[0] - moved[1], moved[2] - moved[3]
        truth = (8.0 * near - far) / (12.0 * steps[:, None])
        found = torch.stack(
            [
                torch.autograd.grad(columns[i, k], given, retain_graph=True)[0][i]
                for k in range(columns.shape[1])
            ],
            dim=-1,
        ).numpy()
        error = np.abs(found - truth)
        largest = np.linalg.norm(truth[:, :28], axis=1)
        assert np.all(error[:, :28].max(axis=1) < 1e-6 * largest)
        # The compiled rim is aimed to 1e-9 mm, which differences enlarge.
        assert np.max(error[:, 28:] * steps[:, None]) < 1e-8


def test_a_vignetted_row_spoils_no_gradient():
    vectors = torch.tensor(np.repeat(mean_vector()[None], 2, axis=0))
    vectors.requires_grad_(True)
    views = ([7.0, 11.0], [555.0, 555.0], [20.0, 74.0], [0.0, 20.0])
    found = field_aberrations_of_eyes(
        vectors, *(torch.tensor(view, dtype=torch.float64) for view in views)
    )
    assert found.ok.tolist() == [True, False]
    columns_of(found)[found.ok].square().sum().backward()
    assert bool(torch.isfinite(vectors.grad).all())
    assert vectors.grad[0].abs().max() > 0.0
    assert vectors.grad[1].abs().max() == 0.0


def test_the_fit_returns_what_it_was_given(rng):
    x_mm, y_mm = rng.uniform(-2.0, 2.0, (2, 3, 120))
    radius_mm = np.array([2.9, 3.0, 3.5])
    truth_um = rng.normal(size=(3, 28))
    values = zernike_values(x_mm / radius_mm[:, None], y_mm / radius_mm[:, None])
    wave_um = np.einsum("bnj,bj->bn", values, truth_um)
    unit = tensors((x_mm / radius_mm[:, None], y_mm / radius_mm[:, None]))
    basis = zernike_basis(*unit).mT.numpy()
    np.testing.assert_allclose(basis, values, atol=1e-12)
    found_um = fit_zernike(
        *tensors((x_mm, y_mm, wave_um, rng.uniform(0.5, 1.0, 120), radius_mm))
    )
    np.testing.assert_allclose(found_um[:, 1:].numpy(), truth_um[:, 1:], atol=1e-9)
    assert bool((found_um[:, 0] == 0.0).all())


def test_the_ellipse_and_the_radius_of_a_known_rim():
    angle = 2.0 * np.pi * np.arange(24) / 24
    centre_mm, semi_mm, axis = np.array([0.3, -0.2]), np.array([3.0, 2.0]), 0.7
    turn = np.array([[np.cos(axis), -np.sin(axis)], [np.sin(axis), np.cos(axis)]])
    along = semi_mm[:, None] * np.stack([np.cos(angle), np.sin(angle)])
    rim = tensors(centre_mm[:, None] + turn @ along)
    rim = [part[None] for part in rim]
    fine = np.linspace(0.0, 2.0 * np.pi, 400_001)
    along = semi_mm[:, None] * np.stack([np.cos(fine), np.sin(fine)])
    farthest_mm = np.hypot(*(centre_mm[:, None] + turn @ along)).max()
    radius_mm = rim_radius(*rim)
    assert radius_mm.item() == pytest.approx(farthest_mm, abs=1e-9)
    matrix = turn @ np.diag(semi_mm) @ turn.T
    truth_mm = [*centre_mm, matrix[0, 0], matrix[0, 1], matrix[1, 1]]
    np.testing.assert_allclose(rim_ellipse(*rim, radius_mm)[0], truth_mm, atol=1e-12)
