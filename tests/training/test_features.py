"""What features claim: eyes that are the same to light look the same to a network."""

import numpy as np
import pytest
import torch

from estimator.estimate.problem import deviations, mean_eyes
from estimator.eye.parameters import column, mean_vector
from estimator.eye.tracing import refraction_of_vectors
from estimator.networks.inference import FIRST_TERM
from estimator.optics.prescription import C20
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.optics.zernike import nm_from_index, zernike_values
from training.datasets import Recipe, draw
from training.eye_features import Shift, ZernikeRotation
from training.eye_prior import squared_deviation
from training.features import (
    FieldFeatures,
    FocusFeatures,
    MeasurementFeatures,
    OnAxisFeatures,
)
from training.focus_features import is_within_reach
from training.tasks import DOMAINS, ZERNIKE_NAMES

N_EYES = 24
VERGENCE = slice(19, 22)
"""Columns of the paraxial vergence: mean, along, across."""


def _turned(rows: np.ndarray) -> np.ndarray:
    """Rows (n, 49) turned about the eye's axis until their field lies on +x."""
    h_rad, v_rad = np.radians(rows[:, 47]), np.radians(rows[:, 48])
    ux, uy = np.sin(h_rad) * np.cos(v_rad), np.sin(v_rad)
    angle_rad, turned = np.arctan2(uy, ux), rows.copy()
    for side in ("anterior", "posterior"):
        turned[:, column(f"cornea_{side}_rotation_deg")] -= np.degrees(angle_rad)
    names = ("lens_decentration_x_mm", "lens_decentration_y_mm")
    x, y = (rows[:, column(name)] for name in names)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turned[:, column(names[0])], turned[:, column(names[1])] = (
        c * x + s * y,
        c * y - s * x,
    )
    about_x = np.radians(rows[:, column("lens_tilt_about_x_deg")])
    about_y = np.radians(rows[:, column("lens_tilt_about_y_deg")])
    x, y = np.sin(about_y) * np.cos(about_x), -np.sin(about_x)
    x, y = c * x + s * y, c * y - s * x
    about_x = np.arcsin(-y)
    turned[:, column("lens_tilt_about_x_deg")] = np.degrees(about_x)
    turned[:, column("lens_tilt_about_y_deg")] = np.degrees(
        np.arcsin(x / np.cos(about_x))
    )
    turned[:, 47], turned[:, 48] = np.degrees(np.arcsin(np.hypot(ux, uy))), 0.0
    return turned


@pytest.fixture(scope="module")
def field_rows():
    rows = draw(Recipe("field", N_EYES, N_EYES, seed=2), 0)
    return rows, _turned(rows)


def test_a_turned_eye_has_the_same_features(field_rows):
    features = FieldFeatures().double()
    rows, turned = (features(torch.from_numpy(part)) for part in field_rows)
    assert torch.max(torch.abs(rows - turned)) < 1e-12


def test_a_turned_eye_has_the_same_encoded_light(field_rows):
    features, encoded = FieldFeatures().double(), []
    for rows in field_rows:
        labels = torch.from_numpy(DOMAINS["field"].label(rows))
        encoded.append(features.encode(torch.from_numpy(rows), labels).numpy())
    good = np.all(np.isfinite(encoded[0] + encoded[1]), axis=1)
    assert good.sum() > N_EYES / 2
    # Both are traced with rays at fixed azimuths, which turn against the eye.
    np.testing.assert_allclose(encoded[0][good], encoded[1][good], atol=2e-5)
    assert np.abs(encoded[0][good]).max() > 1.0


@pytest.mark.parametrize(
    ("kind", "domain"), [(FieldFeatures, "field"), (OnAxisFeatures, "on_axis")]
)
def test_decoding_undoes_encoding(kind, domain):
    rows = torch.from_numpy(draw(Recipe(domain, 64, 64), 0))
    values = torch.randn(64, len(DOMAINS[domain].targets), dtype=torch.float64)
    features = kind().double()
    found = features.decode(rows, features.encode(rows, values))
    assert torch.max(torch.abs(found - values)) < 1e-12


def test_encoded_coefficients_hardly_depend_on_the_pupil():
    rows = np.repeat(draw(Recipe("on_axis", 8, 8, seed=4), 0), 2, axis=0)
    rows[0::2, 45], rows[1::2, 45] = 3.0, 6.0
    labels = DOMAINS["on_axis"].label(rows)
    encoded = OnAxisFeatures().encode(torch.from_numpy(rows), torch.from_numpy(labels))
    astigmatism = encoded[:, [ZERNIKE_NAMES.index(f"zernike_j{j}_um") for j in (3, 5)]]
    raw = torch.from_numpy(labels[:, [2, 4]])
    spread = [
        torch.mean(torch.abs(v[0::2] - v[1::2])) / v.abs().mean()
        for v in (astigmatism, raw)
    ]
    assert spread[0] < 0.4 < 0.9 < spread[1]


def test_turning_terms_turns_the_surface():
    rng = np.random.default_rng(0)
    terms, angle_rad = rng.normal(size=(1, 27)), 0.7
    cosine, sine = (torch.tensor([f(angle_rad)]) for f in (np.cos, np.sin))
    turned = ZernikeRotation()(torch.from_numpy(terms), cosine, sine).numpy()
    radius, theta = rng.uniform(0, 1, 50), rng.uniform(0, 6, 50)

    def surface(values, at):
        x, y = radius * np.cos(at), radius * np.sin(at)
        return zernike_values(x, y)[:, 1:] @ values[0]

    np.testing.assert_allclose(
        surface(turned, theta), surface(terms, theta - angle_rad), atol=1e-12
    )


def test_a_shifted_surface_is_the_surface_elsewhere():
    rng = np.random.default_rng(1)
    terms, shift = rng.normal(size=27), (-0.3, 0.4, 0.5)
    met = Shift().double()(
        torch.from_numpy(terms[None]), *(torch.tensor([v]).double() for v in shift)
    )
    radius, theta = rng.uniform(0, 1, 50), rng.uniform(0, 6, 50)
    u, v = radius * np.cos(theta), radius * np.sin(theta)
    orders = [nm_from_index(j) for j in range(1, 28)]
    norms = np.sqrt([(2 - (m == 0)) * (n + 1) for n, m in orders])
    x, a, b = shift
    wanted = zernike_values(x + a * u, b * v)[:, 1:] @ (terms / norms)
    shown = zernike_values(u, v)[:, 1:] @ met.numpy()[0]
    np.testing.assert_allclose(shown - shown[0], wanted - wanted[0], atol=1e-5)


def test_the_vergence_is_the_refraction_of_a_small_pupil():
    rows = draw(Recipe("on_axis", 16, 16, seed=8), 0)
    odd = [j for j in range(1, 28) if nm_from_index(j)[0] % 2]
    for name in [f"cornea_offset_j{j}_mm" for j in odd]:
        rows[:, column(name)] = 0.0
    for name in ("decentration_x_mm", "decentration_y_mm"):
        rows[:, column(f"lens_{name}")] = 0.0
    for name in ("tilt_about_x_deg", "tilt_about_y_deg"):
        rows[:, column(f"lens_{name}")] = 0.0
    rows[:, 45] = 0.2
    c = DOMAINS["on_axis"].label(rows)
    traced_dpt = np.stack(
        [4 * np.sqrt(3) * c[:, 3], 2 * np.sqrt(6) * c[:, 4], 2 * np.sqrt(6) * c[:, 2]]
    ) / (0.1**2)
    features = OnAxisFeatures().double()(torch.from_numpy(rows)).numpy()
    vergence_dpt = 1e3 * features[:, VERGENCE].T
    np.testing.assert_allclose(vergence_dpt, traced_dpt, atol=0.02)
    assert np.ptp(traced_dpt[0]) > 5.0


def test_the_lens_is_bounded_by_the_features():
    rows = torch.from_numpy(draw(Recipe("focus", 400, 400), 0))
    labels = torch.from_numpy(DOMAINS["focus"].label(rows.numpy()))
    features = FocusFeatures().double()
    free = is_within_reach(rows, labels)
    assert 0.2 < free.double().mean() < 0.8
    # where no bound holds, coding is undone; where one does, what lies beyond is cut
    coded = features.encode(rows, labels)
    beyond = torch.where(labels[:, :1] == 0.0, 0.5, -0.5)
    coded = torch.where(free[:, None], coded, coded + beyond)
    answered = features.decode(rows, coded)
    torch.testing.assert_close(answered, labels, atol=1e-9, rtol=0)


@pytest.mark.parametrize(("pupil_mm", "close_mm"), [(0.4, 3e-3), (3, 6e-3), (6, 0.04)])
def test_a_centered_eye_hardly_needs_a_network_to_focus(pupil_mm, close_mm):
    """No offsets, no tilts: the closed form alone nearly finds the lens."""
    eye = torch.from_numpy(mean_vector())[None].repeat(6, 1)
    focus_dpt = torch.linspace(0.0, 5.0, 6, dtype=torch.float64)
    pupils_mm = torch.full((6, 1), pupil_mm, dtype=torch.float64)
    rows = torch.cat([eye, pupils_mm, focus_dpt[:, None]], dim=1)
    labels = torch.from_numpy(DOMAINS["focus"].label(rows.numpy()))
    features = FocusFeatures().double()
    assert features.encode(rows, labels).abs().max() < close_mm
    missed_mm = features.decode(rows, torch.zeros(6, 1)) - labels
    assert missed_mm.abs().max() < close_mm
    assert labels.abs().max() > 0.5


def test_spherical_aberration_of_a_centered_eye_is_the_traced_one():
    eye = torch.from_numpy(mean_vector())[None]
    features = FocusFeatures().double()
    pupils_mm = torch.tensor([2.0, 4.0, 6.0, 7.0], dtype=torch.float64)
    eyes = eye.repeat(4, 1)
    color_nm = torch.full((4,), REFERENCE_WAVELENGTH_NM, dtype=torch.float64)
    _, excess = features.eye.vergence_of(eyes, pupils_mm, color_nm)
    traced_dpt = [
        refraction_of_vectors(
            eye.numpy(),
            retina=None,
            pupil_diameter_mm=pupil_mm,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )[0]
        for pupil_mm in (0.2, *pupils_mm.tolist())
    ]
    wanted_dpt = traced_dpt[0] - np.array(traced_dpt[1:])
    assert np.abs(wanted_dpt).max() > 0.3
    np.testing.assert_allclose(1e3 * excess(eyes).numpy(), wanted_dpt, atol=0.02)


def test_the_eye_estimator_starts_from_the_mean_eye_of_a_refraction():
    x = torch.zeros(3, 27, dtype=torch.float64)
    x[:, 25], x[:, 26] = 4.0, 555.0
    for row, refraction_dpt in enumerate((-6.0, 0.0, 3.0)):
        x[row, C20 - FIRST_TERM] = -refraction_dpt * 2.0**2 / SPHERE_PER_C20
    found = MeasurementFeatures().decode(x, torch.zeros(3, 45))
    wanted = mean_eyes(np.array([-6.0, 0.0, 3.0]))
    np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-6)
    assert squared_deviation(found, x).max() < 1e-6
    away = found + torch.from_numpy(deviations())
    assert squared_deviation(away, x) == pytest.approx(np.ones(3), rel=1e-5)
