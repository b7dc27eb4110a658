"""Sizes, periods and contrasts of stimuli, measured in their pixels."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimator.acuity.letters import SLOAN_LETTERS
from filter_service.image_files import read_color, write_image
from ocufilter import Eye, EyeFilter, stimuli

Display = stimuli.Display

DISPLAY_NM = (618.0, 536.0, 453.0)
"""Wavelengths of red, green and blue of the default display."""

ALLOWED = 0.005
"""Largest relative error of a size or a period."""

SIZES = [(10.0, 0.37), (7.3, 0.5), (50.0, 0.53)]
"""Heights in arcmin, and pixels in arcmin: 14.6 to 94 px."""


def display(pixel_arcmin=0.5, *, width_px=160, height_px=136, **more):
    return Display(
        width_px=width_px, height_px=height_px, pixel_arcmin=pixel_arcmin, **more
    )


def ink(stimulus):
    """Share of ink of each pixel of a black shape on white."""
    return 1.0 - stimulus.light.astype(np.float64)


def extent_arcmin(stimulus, axis):
    """Extent of a shape whose ends are straight edges along an axis."""
    return ink(stimulus).max(axis=1 - axis).sum() * stimulus.display.pixel_arcmin


@pytest.mark.parametrize(("height_arcmin", "pixel_arcmin"), SIZES)
@pytest.mark.parametrize("letter", "EHKZ")
def test_letters_with_straight_ends_have_their_height(
    letter, height_arcmin, pixel_arcmin
):
    size = {"height_arcmin": height_arcmin, "display": display(pixel_arcmin)}
    if letter == "E":
        found = stimuli.tumbling_e(0.0, **size)
    else:
        found = stimuli.sloan_letters(letter, **size)
    assert extent_arcmin(found, 0) == pytest.approx(height_arcmin, rel=ALLOWED)
    if letter in "EHNZ":
        assert extent_arcmin(found, 1) == pytest.approx(height_arcmin, rel=ALLOWED)


def landolt_area():
    """Area in strokes squared: a ring of radii 2.5 and 1.5 without a gap of 1."""

    def below(radius):  # of the circle, from its axis to y = 1/2
        y = 0.5
        return y * math.sqrt(radius**2 - y**2) + radius**2 * math.asin(y / radius)

    return math.pi * (2.5**2 - 1.5**2) - (below(2.5) - below(1.5))


AREAS = {
    # letter: area in strokes squared
    "C": landolt_area(),
    "D": 5.0 + 2.0 * 1.5 + 0.5 * math.pi * (2.5**2 - 1.5**2),
    "E": 17.0,
    "H": 13.0,
    "O": math.pi * (2.5**2 - 1.5**2),
}


@pytest.mark.parametrize(("height_arcmin", "pixel_arcmin"), SIZES[:2])
@pytest.mark.parametrize(
    ("letter", "turn_deg"),
    [
        *((letter, 0.0) for letter in AREAS),
        *(("C", turn_deg) for turn_deg in (45.0, 90.0, 17.0)),
        *(("E", turn_deg) for turn_deg in (45.0, 90.0, 270.0)),
    ],
)
def test_optotypes_have_the_area_of_their_height(
    letter, height_arcmin, pixel_arcmin, turn_deg
):
    size = {"height_arcmin": height_arcmin, "display": display(pixel_arcmin)}
    if letter in "CE":
        draw = stimuli.landolt_c if letter == "C" else stimuli.tumbling_e
        found = draw(turn_deg, **size)
    else:
        found = stimuli.sloan_letters(letter, **size)
    area = ink(found).sum() * pixel_arcmin**2
    measured_arcmin = 5.0 * math.sqrt(area / AREAS[letter])
    assert measured_arcmin == pytest.approx(height_arcmin, rel=ALLOWED)


@pytest.mark.parametrize(
    ("direction_deg", "side"),
    [(0.0, (0, 1)), (90.0, (-1, 0)), (180.0, (0, -1)), (270.0, (1, 0))],
)
def test_the_gap_of_a_landolt_c_is_a_fifth_of_it_and_where_it_is_told(
    direction_deg, side
):
    found = stimuli.landolt_c(direction_deg, height_arcmin=25.3, display=display(0.5))
    stroke_px = 25.3 / 5.0 / 0.5
    rows, columns = found.light.shape
    # across the middle of the stroke at the gap, within two strokes to each side
    y = round(rows / 2 - 0.5 + 2.0 * stroke_px * side[0])
    x = round(columns / 2 - 0.5 + 2.0 * stroke_px * side[1])
    half = round(1.2 * stroke_px)
    line = ink(found)[:, x][y - half : y + half + 1]
    if side[0]:
        line = ink(found)[y, x - half : x + half + 1]
    gap_px = (1.0 - line).sum()
    assert gap_px == pytest.approx(stroke_px, rel=ALLOWED)


def test_letters_of_a_row_are_as_far_apart_as_told():
    found = stimuli.sloan_letters(
        "HH", height_arcmin=10.0, spacing=0.5, display=display(0.37)
    )
    columns = np.arange(160) + 0.5
    profile = ink(found).sum(axis=0)
    left, right = (
        (columns * profile)[part].sum() / profile[part].sum()
        for part in (slice(0, 80), slice(80, 160))
    )
    assert (right - left) * 0.37 == pytest.approx(15.0, rel=ALLOWED)
    assert (left + right) / 2.0 == pytest.approx(80.0, abs=0.01)


@pytest.mark.parametrize("letter", SLOAN_LETTERS)
def test_a_sloan_letter_is_that_of_the_eye_chart(letter):
    """Ink at the center of each pixel of a letter of 200 px."""
    found = stimuli.sloan_letters(
        letter, height_arcmin=100.0, display=display(0.5, width_px=202, height_px=202)
    )
    places = (np.arange(200) + 0.5) / 40.0
    x, y = places[None, :], places[::-1, None]
    chart = SLOAN_LETTERS[letter](x, y) & (x <= 5.0) & (y <= 5.0)
    assert np.abs(ink(found)[1:-1, 1:-1] - chart).mean() < 0.01


@pytest.mark.parametrize(
    ("x_height_arcmin", "pixel_arcmin"), [(8.0, 0.2), (11.7, 0.23), (23.0, 0.6)]
)
def test_text_has_its_x_height(x_height_arcmin, pixel_arcmin):
    found = stimuli.reading_text(
        "xx", x_height_arcmin=x_height_arcmin, display=display(pixel_arcmin)
    )
    assert extent_arcmin(found, 0) == pytest.approx(x_height_arcmin, rel=ALLOWED)


def test_text_is_broken_into_lines_whose_distance_is_known():
    found = stimuli.reading_text(
        "zzzzz zzzzz", x_height_arcmin=10.0, display=display(0.5)
    )
    rows = ink(found).max(axis=1)
    centers = [
        (np.arange(136) * rows)[part].sum() / rows[part].sum()
        for part in (slice(0, 68), slice(68, 136))
    ]
    assert centers[1] - centers[0] == pytest.approx(2.5 * 20.0, rel=0.01)


def fitted_wave(light, cycles_px):
    """Fit mean, amplitude and frequencies (right, up) in cycles per px."""
    rows, columns = light.shape
    x = np.arange(columns) - (columns - 1) / 2
    y = ((rows - 1) / 2 - np.arange(rows))[:, None]

    def residual(p):
        wave = np.cos(2.0 * np.pi * (p[2] * x + p[3] * y) + p[4])
        return (p[0] + p[1] * wave - light).ravel()

    return least_squares(residual, [0.5, 0.2, *cycles_px, 0.1], x_scale="jac").x


@pytest.mark.parametrize(
    ("frequency_cpd", "orientation_deg"),
    [(3.0, 0.0), (8.7, 90.0), (12.0, 30.0), (29.0, 135.0), (59.0, 0.0)],
)
def test_gratings_have_their_period_orientation_and_contrast(
    frequency_cpd, orientation_deg
):
    contrast = 0.03 * frequency_cpd / 2.0
    found = stimuli.grating(
        frequency_cpd,
        display=display(0.5, width_px=96, height_px=80),
        orientation_deg=orientation_deg,
        phase_deg=20.0,
        contrast=contrast,
    )
    angle = math.radians(orientation_deg)
    guess = frequency_cpd / 120.0 * np.array([math.cos(angle), math.sin(angle)])
    mean, amplitude, right, up, _ = fitted_wave(
        found.light.astype(float), 1.001 * guess
    )
    period_arcmin = 0.5 / math.hypot(right, up)
    assert period_arcmin == pytest.approx(60.0 / frequency_cpd, rel=ALLOWED)
    varies_deg = math.degrees(math.atan2(up, right))
    assert (varies_deg - orientation_deg + 90.0) % 180.0 == pytest.approx(90.0, abs=0.2)
    assert abs(amplitude) / mean == pytest.approx(contrast, rel=ALLOWED)


def contrast_at(light, display, frequency_cpd, orientation_deg):
    """Contrast (channels,) of a known sinusoid in the middle half of a picture."""
    x_px, y_px = display.places_px()
    angle = math.radians(orientation_deg)
    cycles = math.cos(angle) * x_px + math.sin(angle) * y_px
    turns = 2.0 * np.pi * display.cycles_per_px(frequency_cpd) * cycles
    waves = np.stack([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=-1)
    middle = tuple(slice(n // 4, -(n // 4)) for n in turns.shape)
    pixels = light[middle].astype(np.float64)
    fitted = np.linalg.lstsq(
        waves[middle].reshape(-1, 3), pixels.reshape(-1, pixels.shape[-1]), rcond=None
    )[0]
    return np.hypot(fitted[1], fitted[2]) / fitted[0]


def seen_and_expected(
    eye_filter, eye, frequency_cpd, orientation_deg, *, render_tolerance
):
    """Contrasts (3,) of a grating at 4 m with a pupil of 3 mm: seen, and by the MTF."""
    at = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.25}
    pixels = display(0.5, width_px=160, height_px=160)
    grating = stimuli.grating(
        frequency_cpd, display=pixels, orientation_deg=orientation_deg
    )
    seen = eye_filter.filter(
        grating.view(4.0), output="linear", render_tolerance=render_tolerance, **at
    )
    modulation = eye.mtf(
        frequency_cpd=[frequency_cpd],
        orientation_deg=[orientation_deg],
        object_dpt=0.25,
        wavelength_nm=DISPLAY_NM,
        **at,
    )
    # Light is spread evenly over each pixel.
    pixel = np.sinc(frequency_cpd * pixels.pixel_arcmin / 60.0)
    expected = 0.5 * modulation.values.ravel() * pixel
    return contrast_at(seen.color, pixels, frequency_cpd, orientation_deg), expected


@pytest.mark.long("an eye is estimated")
def test_seen_contrast_is_that_of_the_mtf_in_this_orientation():
    body = {
        "kind": "prescription",
        "sphere_dpt": -0.25,
        "cylinder_dpt": -0.75,
        "axis_deg": 30,
        "sample": 0,
    }
    camera = display(0.5, width_px=160, height_px=160).camera
    greens = []
    with EyeFilter(body, camera, engine="native") as eye_filter:
        eye_filter.wait()
        for orientation_deg in (0.0, 60.0):
            found, expected = seen_and_expected(
                *(eye_filter, Eye(body), 12.0, orientation_deg), render_tolerance=0.0
            )
            np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.0005)
            greens.append(found[1])
    assert greens[1] < 0.3 * greens[0]  # by astigmatism


def test_the_amplitude_of_a_sinusoid_is_listed_with_partial_periods():
    pixels = display(0.5, width_px=96, height_px=96)
    for orientation_deg in (0.0, 30.0):
        found = stimuli.grating(12.0, display=pixels, orientation_deg=orientation_deg)
        fitted = contrast_at(found.linear_rgb, pixels, 12.0, orientation_deg)
        listed = found.described()["measured"]["fundamental_contrast"]
        assert listed == pytest.approx(fitted[0], rel=1e-5)
        assert listed == pytest.approx(0.5, rel=1e-5)
    upright = stimuli.grating(12.0, display=pixels)
    assert upright.described()["measured"]["michelson_contrast"] < 0.48
    assert "9.6 periods in the picture: its mean light is 0.4920" in upright.notes[0]
    whole = display(0.5, width_px=100, height_px=96)
    assert stimuli.grating(12.0, display=whole).notes == ()
    small = display(0.1, width_px=400, height_px=96)
    square = stimuli.grating(6.0, wave="square", display=small).described()["measured"]
    assert square["fundamental_contrast"] == pytest.approx(2.0 / np.pi, rel=0.001)


def exact_means(profile, orientation_deg, shape, n=64):
    """Means over pixels of a function of the place across bars, by many samples."""
    rows, columns = shape
    step = (np.arange(n) + 0.5) / n
    x = (np.arange(columns)[:, None] + step).ravel() - columns / 2
    y = rows / 2 - (np.arange(rows)[:, None] + step).ravel()
    angle = math.radians(orientation_deg)
    values = profile(math.cos(angle) * x + math.sin(angle) * y[:, None])
    return values.reshape(rows, n, columns, n).mean(axis=(1, 3))


@pytest.mark.parametrize("orientation_deg", [90.0, 0.0, 45.0, 71.0, 200.0])
@pytest.mark.parametrize("frequency_cpd", [5.0, 37.0])
def test_square_gratings_and_edges_are_means_over_pixels(
    frequency_cpd, orientation_deg
):
    small = display(0.5, width_px=24, height_px=16)
    wave = stimuli.grating(
        frequency_cpd,
        wave="square",
        display=small,
        orientation_deg=orientation_deg,
        phase_deg=25.0,
        contrast=1.0,
    )
    turn = 2.0 * np.pi * small.cycles_per_px(frequency_cpd)
    expected = exact_means(
        lambda px: np.sign(np.cos(turn * px + math.radians(25.0))),
        orientation_deg,
        wave.light.shape,
    )
    # 64 samples across: an edge along a side of a pixel may be half a sample off
    np.testing.assert_allclose(2.0 * wave.light - 1.0, expected, atol=1.1 / 64 * 2)
    assert np.abs(2.0 * wave.light - 1.0 - expected).mean() < 8e-3
    line = stimuli.edge(display=small, orientation_deg=orientation_deg, contrast=1.0)
    expected = exact_means(np.sign, orientation_deg, line.light.shape)
    np.testing.assert_allclose(2.0 * line.light - 1.0, expected, atol=1.1 / 64 * 2)


def test_the_side_of_an_edge_in_its_orientation_is_brighter():
    light = stimuli.edge(display=display(), contrast=0.6, mean_light=0.5).light
    assert light[0, 0] == pytest.approx(0.2)
    assert light[0, -1] == pytest.approx(0.8)
    light = stimuli.edge(display=display(), orientation_deg=90.0, contrast=0.6).light
    assert light[0, 0] == pytest.approx(0.8)
    assert light[-1, 0] == pytest.approx(0.2)


def test_gabors_have_the_envelope_of_their_standard_deviation():
    even, odd = (
        stimuli.gabor(
            10.0, display=display(), sd_arcmin=8.0, phase_deg=phase, contrast=0.8
        ).light.astype(float)
        for phase in (0.0, 90.0)
    )
    power = (even - 0.5) ** 2 + (odd - 0.5) ** 2  # of the envelope alone
    x_arcmin = 0.5 * (np.arange(160) - 79.5)
    profile = power.sum(axis=0)
    sd_arcmin = math.sqrt(2.0 * (x_arcmin**2 * profile).sum() / profile.sum())
    assert sd_arcmin == pytest.approx(8.0, rel=ALLOWED)
    peak = math.sqrt(power.max()) / 0.5
    assert peak == pytest.approx(0.8, rel=0.005)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 1.5])
def test_the_spectrum_of_noise_falls_as_told(exponent):
    found = stimuli.noise(3, display=display(), exponent=exponent, rms_contrast=0.15)
    light = found.light.astype(float)
    spectrum = np.abs(np.fft.fft2(light - light.mean()))
    frequency = np.hypot(np.fft.fftfreq(160)[None, :], np.fft.fftfreq(136)[:, None])
    is_inside = (frequency > 0.0) & (frequency < 0.45)
    slope = np.polyfit(np.log(frequency[is_inside]), np.log(spectrum[is_inside]), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.01)
    assert light.std() / light.mean() == pytest.approx(0.15, rel=1e-4)
    again = stimuli.noise(3, display=display(), exponent=exponent, rms_contrast=0.15)
    np.testing.assert_array_equal(again.light, found.light)


def test_a_disk_of_a_grating_has_its_diameter():
    found = stimuli.grating(
        20.0, display=display(), diameter_arcmin=40.0, contrast=1.0, phase_deg=90.0
    )
    is_inside = np.abs(found.light - 0.5) > 1e-6
    reach_px = np.flatnonzero(is_inside.any(axis=1))
    assert np.ptp(reach_px) + 1 == pytest.approx(80.0, abs=2.0)
    area = is_inside.sum() / is_inside.any(axis=0).sum()
    assert area < 80.0


@pytest.mark.parametrize(
    ("contrast", "background_light", "letter_light"),
    [(-1.0, 1.0, 0.0), (-0.4, 0.5, 0.3), (0.5, 0.4, 0.6)],
)
def test_the_light_of_letters_has_their_weber_contrast(
    contrast, background_light, letter_light
):
    found = stimuli.tumbling_e(
        0.0,
        height_arcmin=25.0,
        display=display(white_nit=200.0),
        contrast=contrast,
        background_light=background_light,
    )
    assert found.light[0, 0] == pytest.approx(background_light)
    assert found.light[68, 80] == pytest.approx(letter_light)
    measured = found.described()["measured"]
    ends = sorted([200.0 * letter_light, 200.0 * background_light])
    assert [measured["least_nit"], measured["most_nit"]] == pytest.approx(ends)
    assert found.parameters["weber_contrast"] == contrast


def test_files_hold_the_light_that_is_told(tmp_path):
    found = stimuli.noise(1, display=display())
    write_image(tmp_path / "a.exr", found.linear_rgb)
    np.testing.assert_array_equal(read_color(tmp_path / "a.exr"), found.linear_rgb)
    code = found.srgb.astype(float) / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    assert np.abs(linear - found.linear_rgb).max() < 0.5 * 2.4 / 1.055 / 255 * 1.05


def test_a_view_has_the_angles_of_the_display():
    view = stimuli.edge(display=display(0.5)).view(4.0)
    assert view.camera.pixel_pitch_mrad[0] == pytest.approx(0.5 * 0.290888, rel=1e-5)
    assert view.tangents[1] == pytest.approx(math.tan(math.radians(40 / 60)), rel=1e-4)
    assert (view.depth_m == 4.0).all()
    inf_m = stimuli.edge(display=display()).view(math.inf).depth_m
    assert np.isinf(inf_m).all()


def test_pixels_of_a_screen_follow_from_its_width_and_distance():
    screen = {"screen_width_mm": 531.0, "screen_width_px": 1920, "distance_m": 1.0}
    size = {"width_px": 64, "height_px": 64}
    found = Display.of_screen(**size, **screen)
    expected = math.degrees(math.atan(0.531 / 1920)) * 60.0
    assert found.pixel_arcmin == pytest.approx(expected)
    Display.of_screen(**size, **screen, pixel_arcmin=0.951)
    with pytest.raises(ValueError, match=r"pixel_arcmin is 1\.2, but .* 0\.95075"):
        Display.of_screen(**size, **screen, pixel_arcmin=1.2)
    with pytest.raises(ValueError, match="width_px is 64; allowed: up to 32"):
        Display.of_screen(**size, **(screen | {"screen_width_px": 32}))


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (lambda d: stimuli.grating(70.0, display=d), r"is 70 .* 0\.5 arcmin.* 60 cpd"),
        (lambda d: stimuli.grating(0.0, display=d), "above 0"),
        (lambda d: stimuli.grating(5.0, display=d, wave="saw"), "'saw'; allowed: sine"),
        (lambda d: stimuli.grating(5.0, display=d, contrast=1.1), "contrast is 1.1"),
        (
            lambda d: stimuli.grating(5.0, display=d, mean_light=0.8),
            r"light of sine_.* is 0\.40\d* to 1\.\d*; allowed: 0",
        ),
        (
            lambda d: stimuli.sloan_letters("K", height_arcmin=100.0, display=d),
            "200 x 200 px in a picture of 160x136; allowed: 0.5 to 68",
        ),
        (
            lambda d: stimuli.sloan_letters("A", height_arcmin=10.0, display=d),
            "text is A; allowed: 1 to 40 of CDHKNORSVZ",
        ),
        (
            lambda d: stimuli.sloan_letters("K", height_arcmin=math.nan, display=d),
            "height_arcmin is nan",
        ),
        (lambda d: stimuli.gabor(5.0, display=d, sd_arcmin=0.1), "sd_arcmin is 0.1"),
        (lambda d: stimuli.noise(-1, display=d), "seed is -1"),
        (lambda d: stimuli.noise(1, display=d, rms_contrast=0.9), "light of noise"),
        (lambda d: stimuli.reading_text(" ", x_height_arcmin=9, display=d), "empty"),
        (
            lambda d: stimuli.reading_text("z" * 99, x_height_arcmin=9, display=d),
            "wider than the picture",
        ),
        (
            lambda d: stimuli.reading_text("z", x_height_arcmin=9, display=d, font="?"),
            r"font '\?' cannot be read",
        ),
        (lambda d: Display(width_px=4, height_px=64, pixel_arcmin=1), "width_px is 4"),
    ],
)
def test_what_cannot_be_drawn_is_refused_with_values(draw, words):
    with pytest.raises(ValueError, match=words):
        draw(display(0.5))


def test_strokes_and_periods_of_few_pixels_are_noted():
    size = {"display": display(0.5)}
    assert stimuli.landolt_c(0.0, height_arcmin=5.1, **size).notes == ()
    (note,) = stimuli.landolt_c(0.0, height_arcmin=4.9, **size).notes
    assert "strokes are 1.96 px wide" in note
    assert "px per period" not in " ".join(stimuli.grating(29.0, **size).notes)
    assert "3 px per period" in stimuli.grating(40.0, **size).notes[0]
