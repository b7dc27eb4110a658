"""Letter charts of a report, through the filter itself."""

import numpy as np
import pytest

from clients.figures import EyeStudy
from clients.report.facts import FIELD_DEG, LOG_MAR, charts_of
from clients.scenes.letter_chart import letter_chart
from filter_service import Camera

OLD = {
    "kind": "prescription",
    "sphere_dpt": 0.0,
    "age_years": 70,
    "higher_order": "none",
}


def _light(picture):
    srgb = picture[..., 1] / 255.0
    return np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


@pytest.fixture(scope="module")
def charts():
    return charts_of(EyeStudy.of(OLD), pupils_mm=(3.0,), distances_m=(0.4, 6.0))


def _contrast(picture, row):
    """Modulation along a row's letters."""
    top, bottom = row.y_px - row.height_px / 2, row.y_px + row.height_px / 2
    light = _light(picture)[round(top) : round(bottom)]
    return 1.0 - light.min() / light.max()


def test_a_presbyope_reads_far_and_not_near(charts):
    camera = Camera.from_fov(FIELD_DEG, width_px=860, height_px=860)
    chart = letter_chart(camera, distance_m=6.0, log_mar=LOG_MAR)
    rows = {row.log_mar: row for row in chart.rows}
    far, near = charts[3.0, 6.0], charts[3.0, 0.4]
    assert _contrast(far, rows[0.1]) > 0.5
    # 2.5 dpt through 3 mm: a disc of 26 arcmin; strokes of 1.3 are gone, 10 are not
    assert _contrast(near, rows[0.1]) < 0.2
    assert _contrast(near, rows[1.0]) > 0.3


def test_blur_moves_light_and_keeps_it(charts):
    whole = [_light(picture).mean() for picture in charts.values()]
    assert whole[0] == pytest.approx(whole[1], rel=2e-3)
