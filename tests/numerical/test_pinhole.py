"""The pinhole's local scale against finite differences and the sec laws."""

import math

import numpy as np
import pytest

from estimator.optics.pinhole import direction_deg, pixel_from_mrad, tangents_at

TANGENTS = (-0.9, 0.7, 0.5, -0.45)
SIZE_PX = (1280, 720)
FIELDS_DEG = [(0, 0), (30, 0), (0, 20), (-35, 22), (41, -24), (12, 7)]


def direction(h_deg, v_deg):
    h, v = math.radians(h_deg), math.radians(v_deg)
    return np.array(
        [math.sin(h) * math.cos(v), math.sin(v), -math.cos(h) * math.cos(v)]
    )


def image_point_px(u):
    """Pixels, x right and y up, of a direction."""
    left, right, up, down = TANGENTS
    tangent_x, tangent_y = u[0] / -u[2], u[1] / -u[2]
    return np.array(
        [
            (tangent_x - left) / (right - left) * SIZE_PX[0],
            (tangent_y - down) / (up - down) * SIZE_PX[1],
        ]
    )


@pytest.mark.parametrize("field_deg", FIELDS_DEG)
def test_jacobian_equals_finite_differences_along_the_pupil_axes(field_deg):
    u = direction(*field_deg)
    ex = np.cross(u, [0.0, 1.0, 0.0])
    ex /= np.linalg.norm(ex)
    ey = np.cross(ex, u)
    step = 1e-5
    columns = [
        (image_point_px(u + step * e) - image_point_px(u - step * e)) / (2 * step)
        for e in (ex, ey)
    ]
    found = pixel_from_mrad(*field_deg, tangents=TANGENTS, size_px=SIZE_PX)
    # Central differences: the step squared, in pixels per rad.
    np.testing.assert_allclose(found, np.array(columns).T / 1000.0, atol=1e-8)


def test_scale_grows_with_sec_squared_along_the_radius_and_sec_across():
    h = math.radians(35.0)
    at_axis = pixel_from_mrad(0.0, 0.0, tangents=TANGENTS, size_px=SIZE_PX)
    found = pixel_from_mrad(35.0, 0.0, tangents=TANGENTS, size_px=SIZE_PX) / at_axis[
        [0, 1], [0, 1]
    ].reshape(2, 1)
    expected = np.diag([1.0 / math.cos(h) ** 2, 1.0 / math.cos(h)])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_pitch_at_the_axis_is_that_of_the_conventions():
    jacobian = pixel_from_mrad(0.0, 0.0, tangents=TANGENTS, size_px=SIZE_PX)
    pitch_mrad = 1000.0 * np.array([1.6 / 1280, 0.95 / 720])
    np.testing.assert_allclose(jacobian, np.diag(1.0 / pitch_mrad), rtol=1e-12)


def test_image_points_and_directions_go_round():
    x_px, y_px = np.array([0.0, 1280.0, 333.3]), np.array([0.0, 720.0, 600.1])
    tangents = tangents_at(x_px, y_px, tangents=TANGENTS, size_px=SIZE_PX)
    assert (tangents[0][0], tangents[1][0]) == pytest.approx((-0.9, 0.5))
    h_deg, v_deg = direction_deg(*tangents)
    for h, v, x, y in zip(h_deg, v_deg, x_px, y_px, strict=True):
        found = image_point_px(direction(h, v))
        np.testing.assert_allclose(found, (x, 720.0 - y), atol=1e-9)


def test_impossible_cameras_and_directions_are_refused():
    with pytest.raises(ValueError, match="left < right"):
        pixel_from_mrad(0.0, 0.0, tangents=(1, -1, 1, -1), size_px=SIZE_PX)
    with pytest.raises(ValueError, match="within 90 degrees"):
        pixel_from_mrad(95.0, 0.0, tangents=TANGENTS, size_px=SIZE_PX)
