"""The letter chart: sizes against trigonometry, shapes against their areas."""

import math

import numpy as np
import pytest

from clients.scenes.letter_chart import LOG_MAR_ROWS, SLOAN_LETTERS, letter_chart
from filter_service import Camera

HALF_LIGHT = 188
"""Half of white, in sRGB."""


def _camera(side_px=800, fov_deg=8.4):
    return Camera.from_fov(fov_deg, width_px=side_px, height_px=side_px)


def _dark_box(picture):
    rows, columns = np.nonzero(picture < HALF_LIGHT)
    return rows.min(), rows.max() + 1, columns.min(), columns.max() + 1


@pytest.mark.parametrize("log_mar", [0.3, 0.7, 1.0])
def test_a_letter_is_as_high_as_its_angle_says(log_mar):
    camera = _camera()
    chart = letter_chart(camera, distance_m=4.0, log_mar=[log_mar], letters=["H"])
    top, bottom, left, right = _dark_box(chart.view.color[..., 0])
    half_rad = math.radians(5 * 10**log_mar / 60) / 2
    expected_px = 800 * math.tan(half_rad) / math.tan(math.radians(4.2))
    assert bottom - top == pytest.approx(expected_px, abs=1.01)
    assert right - left == pytest.approx(expected_px, abs=1.01)
    assert chart.rows[0].height_px == pytest.approx(expected_px, rel=1e-9)
    assert (top + bottom) / 2 == pytest.approx(chart.rows[0].y_px, abs=0.51)


def test_rows_shrink_by_a_tenth_of_a_logarithm_and_stand_apart_by_the_next():
    chart = letter_chart(_camera(), distance_m=6.0)
    heights = np.array([row.height_px for row in chart.rows])
    assert heights[:-1] / heights[1:] == pytest.approx(10**0.1, rel=1e-4)
    middles = np.array([row.y_px for row in chart.rows])
    gaps = np.diff(middles) - (heights[1:] + heights[:-1]) / 2
    assert gaps == pytest.approx(heights[1:], rel=1e-9)
    assert [row.log_mar for row in chart.rows] == list(LOG_MAR_ROWS)


def test_five_letters_stand_a_letter_apart():
    chart = letter_chart(_camera(), distance_m=6.0, log_mar=[0.9], letters=["HHHHH"])
    dark = (chart.view.color[..., 0] < HALF_LIGHT).any(axis=0)
    edges = np.flatnonzero(np.diff(dark.astype(int)))
    widths = np.diff(edges)
    assert widths == pytest.approx(np.full(9, chart.rows[0].height_px), abs=1.01)


def test_it_lies_at_its_distance_and_looks_the_same_from_there():
    near = letter_chart(_camera(), distance_m=0.4)
    far = letter_chart(_camera(), distance_m=6.0)
    assert np.all(near.view.depth_m == np.float32(0.4))
    assert np.array_equal(near.view.color, far.view.color)


AREAS = {
    # strokes of width 1 in a box of 5 by 5
    "H": 5 + 5 + 3,
    "O": math.pi * (2.5**2 - 1.5**2),
    "Z": 5 + 5 + 3 * 1.4,
    "D": 5 + 2 * 1.5 + math.pi * (2.5**2 - 1.5**2) / 2,
    "S": 6 + 3 * math.pi * (1.5**2 - 0.5**2) / 2,
}


@pytest.mark.parametrize(("letter", "area"), AREAS.items())
def test_letters_have_the_ink_of_their_strokes(letter, area):
    places = (np.arange(1000) + 0.5) / 200
    ink = SLOAN_LETTERS[letter](places[None, :], places[:, None])
    assert ink.mean() * 25 == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("letter", SLOAN_LETTERS)
def test_letters_reach_all_sides_of_their_box_and_are_one_piece(letter):
    from scipy.ndimage import label

    places = (np.arange(400) + 0.5) / 80
    ink = SLOAN_LETTERS[letter](places[None, :], places[:, None])
    edge = 5  # a gap may cut off a round letter's outermost bit
    sides = ink[:edge], ink[-edge:], ink[:, :edge], ink[:, -edge:]
    assert all(side.any() for side in sides)
    assert label(ink)[1] == 1


def test_light_of_a_pixel_is_the_share_without_ink():
    coarse = letter_chart(_camera(100), distance_m=1.0, log_mar=[1.0], letters=["N"])
    fine = letter_chart(_camera(1600), distance_m=1.0, log_mar=[1.0], letters=["N"])

    def ink(chart):
        srgb = chart.view.color[..., 0] / 255
        return np.mean(
            1 - np.where(srgb < 0.04, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        )

    assert ink(coarse) == pytest.approx(ink(fine), rel=0.04)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"distance_m": 0.0}, "distance_m is 0; allowed: above 0"),
        ({"letters": ["AB"]}, "letters are 'AB'; allowed: rows of CDHKNORSVZ"),
        ({"log_mar": [4.0]}, "log_mar is 4; allowed: -1 to 2.5"),
        ({"log_mar": [1.4]}, "more than the field of view"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        letter_chart(_camera(), **({"distance_m": 1.0} | change))
