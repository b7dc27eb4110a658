"""The solver of pictures, on dense matrices and convolutions, and its weight."""

import numpy as np
import pytest
from scipy import fft
from scipy.optimize import lsq_linear

from estimator.acuity.transfer import HIGHEST_CPD, neural_sensitivity
from filter_service.camera import Camera
from filter_service.correcting import (
    SensitivityWeight,
    nearest_picture,
    solver,
)
from filter_service.errors import BadMessage

SHAPE = (4, 5, 3)
N_VALUES = 60


class Dense:
    """An operator with a matrix."""

    def __init__(self, matrix, color_shape=SHAPE, image_shape=SHAPE):
        self.matrix = matrix.astype(np.float32)
        self.color_shape, self.image_shape = color_shape, image_shape

    def forward(self, color):
        return (self.matrix @ color.ravel()).reshape(self.image_shape)

    def adjoint(self, image):
        return (self.matrix.T @ image.ravel()).reshape(self.color_shape)


class Blur:
    """A periodic convolution with a kernel (height, width) in the corner."""

    def __init__(self, kernel):
        self.color_shape = self.image_shape = (*kernel.shape, 3)
        self.transfer = fft.rfft2(kernel)[..., None]

    def _times(self, image, transfer):
        found = fft.rfft2(image, axes=(0, 1)) * transfer
        return fft.irfft2(found, s=image.shape[:2], axes=(0, 1)).astype(np.float32)

    def forward(self, color):
        return self._times(color, self.transfer)

    def adjoint(self, image):
        return self._times(image, self.transfer.conj())


def blurring_matrix(rng):
    """Rows of nonnegative weights about the diagonal, with unit sums."""
    k = np.arange(N_VALUES)
    matrix = rng.random((N_VALUES, N_VALUES)) * np.exp(-np.abs(k[:, None] - k) / 2.0)
    return matrix / matrix.sum(axis=1, keepdims=True)


def least_error(matrix, target, limits=(0.0, 1.0)):
    """Mean square of the residuals at the minimum, by a solver of SciPy."""
    found = lsq_linear(matrix, target, bounds=limits, method="bvls")
    return 2.0 * found.cost / target.size, found.x


@pytest.mark.parametrize("limits", [(0.0, 1.0), (0.2, 0.7)])
def test_the_picture_is_that_of_another_solver(rng, limits):
    matrix, target = blurring_matrix(rng), rng.random(SHAPE)
    least, x = least_error(matrix, target.ravel(), limits)
    found = nearest_picture(
        [Dense(matrix)], [target], limits=limits, tolerance=0.0, max_iterations=400
    )
    assert np.isclose(min(found.errors), least, rtol=1e-4)
    assert np.abs(found.color.ravel() - x).max() < 0.02
    assert found.color.min() >= np.float32(limits[0])
    assert found.color.max() <= np.float32(limits[1])
    assert np.mean((found.color == 0.0) | (found.color == 1.0)) > 0.1 or limits[0] > 0.0


def test_the_least_mean_over_operators_of_different_sizes(rng):
    shape = (2, 5, 3)
    first, second = blurring_matrix(rng), blurring_matrix(rng)[:30]
    targets = rng.random(SHAPE), rng.random(shape)
    stacked = np.concatenate([target.ravel() for target in targets])
    least, _ = least_error(np.concatenate([first, second]), stacked)
    operators = Dense(first), Dense(second, image_shape=shape)
    found = nearest_picture(operators, targets, tolerance=0.0, max_iterations=400)
    assert np.isclose(min(found.errors), least, rtol=1e-4)


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
@pytest.mark.parametrize("start", ["target", None])
def test_it_stops_within_its_tolerance_and_its_bound_holds(rng, tolerance, start):
    matrix, target = blurring_matrix(rng), rng.random(SHAPE)
    least, _ = least_error(matrix, target.ravel())
    found = nearest_picture(
        [Dense(matrix)],
        [target],
        start=target if start else None,
        tolerance=tolerance,
    )
    assert found.has_converged
    assert found.lower_bound <= least * (1.0 + 1e-5)
    assert min(found.errors) - least <= tolerance * (found.errors[0] - least)
    seen = matrix @ found.color.ravel() - target.ravel()
    assert np.isclose(np.mean(seen**2), min(found.errors), rtol=1e-4)
    assert found.iteration_count == len(found.errors) - 1 < 200


def test_a_target_within_reach_is_reached(rng):
    matrix, wanted = blurring_matrix(rng) + 2.0 * np.eye(N_VALUES), rng.random(SHAPE)
    operator = Dense(matrix)
    found = nearest_picture(
        [operator], [operator.forward(wanted)], tolerance=0.0, max_iterations=300
    )
    assert np.abs(found.color - wanted).max() < 1e-3


def test_a_step_that_is_too_long_is_shortened(rng, monkeypatch):
    monkeypatch.setattr(solver, "MAX_POWER_STEPS", 1)
    # Its greatest curvature is along a direction without a mean, far above the noise's.
    wave = np.where(np.arange(N_VALUES) % 2, 1.0, -1.0)
    matrix = blurring_matrix(rng) + 40.0 * np.outer(wave, wave) / N_VALUES
    target = rng.random(SHAPE)
    least, _ = least_error(matrix, target.ravel())
    found = nearest_picture(
        [Dense(matrix)], [target], tolerance=0.0, max_iterations=2000
    )
    assert np.isclose(min(found.errors), least, rtol=1e-2)


@pytest.fixture
def defocus():
    """A blur by a disc of 3 px."""
    y, x = (np.minimum(k, k[::-1] + 1) for k in (np.arange(32), np.arange(48)))
    kernel = (np.hypot(y[:, None], x) <= 3.0).astype(float)
    return Blur(kernel / kernel.sum())


@pytest.fixture
def squares(rng):
    """Squares of random light."""
    return np.kron(rng.random((4, 6, 3)), np.ones((8, 8, 1)))


def test_it_is_not_worse_than_a_clipped_wiener_filter(defocus, squares):
    found = nearest_picture([defocus], [squares], start=squares)
    h, t = defocus.transfer, fft.rfft2(squares, axes=(0, 1))
    for regularization in 10.0 ** np.arange(-4, 1):
        ratio = (1.0 + regularization) * h.conj() / (np.abs(h) ** 2 + regularization)
        wiener = fft.irfft2(t * ratio, s=squares.shape[:2], axes=(0, 1)).clip(0.0, 1.0)
        error = np.mean((defocus.forward(wiener) - squares) ** 2)
        assert min(found.errors) < error


def test_momentum_that_points_uphill_is_dropped(defocus, squares):
    target = 0.5 + 0.3 * (squares - 0.5)
    few, many = (
        nearest_picture(
            [defocus], [target], start=target, tolerance=0.0, max_iterations=n
        ).errors
        for n in (60, 300)
    )
    assert few[-1] - min(many) < 0.015 * (few[0] - min(many))  # 0.028 without


def test_differences_are_weighted(rng):
    camera = Camera.from_fov(1.0, width_px=5, height_px=4)
    weight, matrix = SensitivityWeight(camera), blurring_matrix(rng)
    target = rng.random(SHAPE)
    filters = np.stack(
        [weight.forward(one.reshape(SHAPE)).ravel() for one in np.eye(N_VALUES)], axis=1
    )
    least, _ = least_error(filters @ matrix, filters @ target.ravel())
    found = nearest_picture(
        [Dense(matrix)], [target], weight=weight, tolerance=0.0, max_iterations=1000
    )
    assert np.isclose(min(found.errors), least, rtol=1e-2)
    assert found.lower_bound <= least * (1.0 + 1e-5)


@pytest.mark.parametrize(
    ("across", "along"), [(0, 0), (3, 0), (0, 4), (5, 2), (47, 31)]
)
def test_a_grating_is_weighted_by_the_neural_sensitivity(rng, across, along):
    camera = Camera.from_fov(0.25, width_px=48, height_px=32)
    weight = SensitivityWeight(camera)
    x = np.cos(np.pi * across * (np.arange(48) + 0.5) / 48)
    y = np.cos(np.pi * along * (np.arange(32) + 0.5) / 32)
    grating = (y[:, None] * x)[..., None] * np.ones(3)
    pitch_x_deg, pitch_y_deg = np.degrees(np.array(camera.pixel_pitch_mrad) / 1e3)
    cpd = np.hypot(across / (96 * pitch_x_deg), along / (64 * pitch_y_deg))
    highest = neural_sensitivity(np.linspace(0.0, 60.0, 6001)).max()
    wanted = neural_sensitivity(cpd) / highest if cpd <= HIGHEST_CPD else 0.0
    found = weight.forward(grating.astype(np.float32))
    ratio = np.linalg.norm(found) / np.linalg.norm(grating)
    assert np.isclose(ratio, wanted, rtol=1e-3, atol=1e-6)
    other = rng.random(grating.shape, np.float32)
    sums = np.vdot(found, other), np.vdot(grating, weight.adjoint(other))
    assert np.isclose(*sums, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"operators": []}, r"targets: there are 1 for 0 operators \(allowed: one for"),
        ({"targets": []}, r"targets: there are 0 for 1 operators \(allowed: one for"),
        ({"targets": [np.zeros((2, 3))]}, r"targets\[0\]: it has shape \(2, 3\) "),
        ({"targets": [np.full(SHAPE, np.nan)]}, r"targets\[0\]: 60 values are not fin"),
        (
            {"start": np.zeros(3)},
            r"start: it has shape \(3,\) \(allowed: \(4, ",
        ),
        (
            {"limits": (1.0, 0.0)},
            r"limits: they are \[1.0, 0.0\] \(allowed: low ",
        ),
        ({"limits": (0.0, np.inf)}, "limits: they are .*allowed: low < high"),
        ({"tolerance": 2.0}, r"tolerance: it is 2.0 \(allowed: 0 to 1\)"),
        ({"max_iterations": 0}, r"max_iterations: it is 0 \(allowed: 1 to 100000\)"),
    ],
)
def test_bad_input_is_named(change, said):
    given = {"operators": [Dense(np.eye(N_VALUES))], "targets": [np.zeros(SHAPE)]}
    with pytest.raises(BadMessage, match=said):
        nearest_picture(**given | change)


def test_operators_take_the_same_pictures():
    operators = Dense(np.eye(N_VALUES)), Dense(np.eye(N_VALUES), color_shape=(5, 4, 3))
    with pytest.raises(BadMessage, match="operators: their pictures have shapes"):
        nearest_picture(operators, [np.zeros(SHAPE)] * 2)


def test_a_black_operator_leaves_the_start(rng):
    start = rng.random(SHAPE, np.float32)
    black = Dense(np.zeros((N_VALUES, N_VALUES)))
    found = nearest_picture([black], [start], start=start)
    assert found.has_converged
    np.testing.assert_array_equal(found.color, start)
