"""Detail that the retina could resolve: Watson's formula, and gratings."""

import numpy as np
import pytest

from filter_service import peripheral_resolution
from filter_service.camera import Camera
from filter_service.errors import BadMessage
from filter_service.peripheral_resolution import limit_resolution, resolution_cpd

CAMERA = Camera.from_fov(40.0, width_px=201, height_px=161)
MIDDLE = (80, 100)


def test_the_map_agrees_with_watson_at_the_fovea_and_at_10_deg():
    found = resolution_cpd(CAMERA, eye_side="OD")
    assert found[MIDDLE] == pytest.approx(65.37, abs=0.01)
    assert np.unravel_index(found.argmax(), found.shape) == MIDDLE
    # Watson 2014, equations 7 to 9 and table 1 by hand, 10 deg in the temporal field:
    # 33163.2 (0.9851 / (1 + 10 / 1.058)² + 0.0149 exp(-10 / 22.14)) / 1.12
    # / (1 + 10 / 41.03) = 440.2 cells/deg² of both types
    # Nyquist frequency of half of them in a hexagonal lattice: sqrt(220.1 / 2 sqrt(3))
    camera = Camera.from_fov(1.0, width_px=3, height_px=3)
    aside = resolution_cpd(camera, eye_side="OD", gaze_deg=(-10.0, 0.0))
    assert aside[1, 1] == pytest.approx(np.sqrt(220.1 / (2.0 * np.sqrt(3.0))), 2e-3)
    other = resolution_cpd(camera, eye_side="OS", gaze_deg=(-10.0, 0.0))
    assert other[1, 1] < aside[1, 1]


@pytest.mark.parametrize(("ratio", "expected"), [(0.5, 0.9576), (1.0, 0.5), (2.0, 0.0)])
def test_a_grating_at_the_limit_keeps_half_its_contrast(monkeypatch, ratio, expected):
    """With the same limit everywhere, the result is the closed form."""
    camera = Camera.from_fov(10.0, width_px=128, height_px=128)
    monkeypatch.setattr(
        peripheral_resolution,
        "resolution_cpd",
        lambda *_, **__: np.full((128, 128), 1.28),
    )
    monkeypatch.setattr(
        peripheral_resolution, "_pixel_deg", lambda _: np.full((128, 128), 10.0 / 128)
    )
    cycles_per_px = ratio * 0.1
    grating = np.cos(2.0 * np.pi * cycles_per_px * np.arange(128))
    image = np.broadcast_to((1.0 + grating)[:, None, None], (128, 128, 1))
    seen = limit_resolution(image.astype(np.float32), camera, eye_side="OD")
    inside = slice(30, 98)
    contrast = (
        (seen[inside, 64, 0] - 1.0)
        @ grating[inside]
        / (grating[inside] @ grating[inside])
    )
    assert contrast == pytest.approx(expected, abs=0.01)


def test_detail_remains_where_the_eye_looks_and_vanishes_beside_it():
    camera = Camera.from_fov(40.0, width_px=400, height_px=60)
    stripes = 0.5 + 0.5 * np.cos(np.pi * np.arange(400) / 2.0)
    image = np.broadcast_to(stripes[None, :, None], (60, 400, 3)).astype(np.float32)
    seen = limit_resolution(image, camera, eye_side="OD", gaze_deg=(0.0, 0.0))
    assert np.array_equal(seen[30, 199:201], image[30, 199:201])
    assert seen[30, 10:40, 1].std() < 0.2 * image[30, 10:40, 1].std()
    assert seen.mean() == pytest.approx(0.5, abs=0.01)


def test_wrong_arguments_are_named():
    image = np.zeros((161, 201, 3), np.float32)
    for call in (
        lambda: resolution_cpd(CAMERA, eye_side="left"),
        lambda: limit_resolution(image[1:], CAMERA, eye_side="OD"),
        lambda: limit_resolution(image.astype(np.uint8), CAMERA, eye_side="OD"),
    ):
        with pytest.raises(BadMessage, match="allowed"):
            call()
