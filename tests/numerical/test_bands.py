"""`BandFilter`: bands against channels of RGB frames, yellowing, and cone signals."""

import numpy as np
import pytest

from estimator.color import lms_weights
from estimator.media import channel_gains
from filter_service.camera import Camera
from filter_service.errors import BadMessage
from filter_service.filtering import BandFilter, EyeFilter
from filter_service.filtering.band_filter import band_groups
from filter_service.rendering.band_copies import joined_bands, split_bands
from filter_service.settings import DEFAULTS

CAMERA = Camera.from_fov(6.0, width_px=48, height_px=32)
SHAPE = (32, 48)
STATE = {"pupil_diameter_mm": 4.3, "focus_dpt": 0.7}
APART = {"merge": False, "bright_pixels": False}
MYOPIA = {"kind": "prescription", "sphere_dpt": -1.0}
SETTINGS = {"mode": "on-axis"}


@pytest.fixture(scope="module", autouse=True)
def _one_worker():
    """Keep the build worker of all filters, which takes a second to start."""
    with EyeFilter(engine="native"):
        yield


def two_depths_m():
    """A near surface in the left half."""
    return np.where(np.arange(48) < 24, 0.5, 5.0) * np.ones(SHAPE, np.float32)


def scene(count):
    """Noise of many bands, and its depth."""
    bands = np.random.default_rng(3).random((*SHAPE, count), np.float32)
    return bands, two_depths_m().astype(np.float32)


@pytest.mark.long("builds eyes")
def test_bands_of_the_display_equal_the_channels_of_an_rgb_frame():
    bands, depth_m = scene(5)
    rgb = np.ascontiguousarray(bands[..., [4, 2, 0]])
    with EyeFilter(MYOPIA, CAMERA, SETTINGS, engine="native") as eye_filter:
        expected = eye_filter.filter(rgb, depth_m, output="linear", **STATE).color
    nm = [453.0, 500.0, 536.0, 600.0, 618.0]
    with BandFilter(
        MYOPIA, CAMERA, SETTINGS, wavelengths_nm=nm, engine="native"
    ) as band_filter:
        seen = band_filter.filter(bands, depth_m, **STATE)
    assert np.array_equal(seen.bands[..., [4, 2, 0]], expected)
    assert [frame.color.size for frame in seen.groups] == [0, 0]
    assert not np.array_equal(seen.bands[..., 1], seen.bands[..., 3])


@pytest.mark.long("builds eyes")
def test_one_band_of_the_display_equals_its_channel_if_channels_are_independent():
    bands, depth_m = scene(3)
    with EyeFilter(MYOPIA, CAMERA, SETTINGS, engine="native") as eye_filter:
        rgb = eye_filter.filter(bands, depth_m, output="linear", **STATE, **APART)
    own = np.ascontiguousarray(bands[..., :1])
    with BandFilter(
        MYOPIA, CAMERA, SETTINGS, wavelengths_nm=[618.0], engine="native"
    ) as band_filter:
        seen = band_filter.filter(own, depth_m, **STATE, **APART)
    assert np.array_equal(seen.bands[..., 0], rgb.color[..., 0])


@pytest.mark.long("builds eyes")
def test_yellowing_acts_once_in_cone_signals():
    """A uniform image has the signals of its spectrum for a lens of that age."""
    nm = np.arange(400.0, 701.0, 60.0)
    spectrum = np.linspace(0.2, 1.0, nm.size).astype(np.float32)
    uniform = np.ascontiguousarray(np.broadcast_to(spectrum, (*SHAPE, nm.size)))
    depth_m = np.full(SHAPE, 1.0, np.float32)
    yellow = MYOPIA | {"yellowing": "seen", "age_years": 70.0}
    with BandFilter(
        yellow, CAMERA, SETTINGS, wavelengths_nm=nm, engine="native"
    ) as band_filter:
        seen = band_filter.filter(uniform, depth_m, **STATE)
    np.testing.assert_allclose(seen.bands, uniform, rtol=1e-5)
    expected = spectrum @ lms_weights(nm, age_years=70.0)
    dimmed = spectrum * channel_gains(nm, age_years=70.0, yellowing="seen")
    twice = dimmed @ lms_weights(nm, age_years=70.0)
    found = seen.lms()[SHAPE[0] // 2, SHAPE[1] // 2]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.all(np.abs(found - twice) > 0.01)
    young = seen.lms(age_years=32.0)[SHAPE[0] // 2, SHAPE[1] // 2]
    assert abs(young[2] - found[2]) > 0.01


@pytest.mark.long("builds eyes")
def test_hidden_bands_are_seen_past_a_near_edge():
    bands, depth_m = scene(2)
    hidden_m = np.where(np.arange(48) < 24, 5.0, 0.0) * np.ones(SHAPE)
    hidden = np.full_like(bands, 10.0)
    with BandFilter(
        MYOPIA, CAMERA, SETTINGS, wavelengths_nm=[500.0, 600.0], engine="native"
    ) as band_filter:
        without = band_filter.filter(bands, depth_m, **STATE)
        seen = band_filter.filter(
            bands,
            depth_m,
            hidden_bands=hidden,
            hidden_depth_m=hidden_m.astype(np.float32),
            **STATE,
        )
    assert (seen.bands - without.bands).max() > 0.5


def test_bands_are_copied_to_frames_and_back():
    """Two items of work, and a group with one band."""
    image = np.random.default_rng(5).random((50, 60, 7), np.float32)
    band_of = np.array([[6, 0, 3], [1, 5, 2], [4, 4, 4]])
    frames = split_bands(image, band_of)
    assert np.array_equal(frames, np.moveaxis(image[..., band_of], 2, 0))
    places = np.array([[0, 1], [1, 0], [1, 2], [0, 2], [2, 1], [1, 1], [0, 0]])
    assert np.array_equal(joined_bands(list(frames), places), image)


@pytest.mark.long("builds eyes")
def test_half_floats_are_filtered_like_the_same_values_in_float32():
    bands, depth_m = scene(4)
    halves = bands.astype(np.float16)
    nm = [450.0, 500.0, 550.0, 600.0]
    with BandFilter(
        MYOPIA, CAMERA, SETTINGS, wavelengths_nm=nm, engine="native"
    ) as band_filter:
        seen = band_filter.filter(halves, depth_m, **STATE)
        expected = band_filter.filter(halves.astype(np.float32), depth_m, **STATE)
    assert np.array_equal(seen.bands, expected.bands)


def test_the_thread_waits_for_the_end_of_an_image(monkeypatch):
    """After each frame it would look for predicted PSFs of all groups."""
    with EyeFilter(engine="native") as eye_filter:
        builder, woken = eye_filter.builder, []
        monkeypatch.setattr(builder._wake, "set", lambda: woken.append(True))
        with pytest.raises(RuntimeError), builder.as_one_frame():
            for _ in range(3):
                builder.end_frame(eye_filter._eyes, 0.001)
            assert not woken
            raise RuntimeError
        assert len(woken) == 1
        builder.end_frame(eye_filter._eyes, 0.001)
        assert len(woken) == 2


def test_the_order_of_bands_does_not_matter():
    nm = np.array([453.0, 480.0, 520.0, 560.0, 600.0, 660.0, 700.0])
    groups = band_groups(nm, DEFAULTS)
    assert sorted(b for group in groups for b in group.bands) == list(range(7))
    shuffled = np.random.default_rng(0).permutation(nm.size)
    again = band_groups(nm[shuffled], DEFAULTS)
    assert [g.wavelengths_nm for g in again] == [g.wavelengths_nm for g in groups]


@pytest.mark.parametrize(
    ("wavelengths_nm", "named"),
    [
        ([], "1 to 256"),
        ([[500.0]], "shape"),
        ([370.0, 500.0], "370 nm"),
        ([500.0, 500.0], "given twice"),
        ([500.0, np.nan], "nan nm"),
    ],
)
def test_wavelengths_out_of_range_are_named(wavelengths_nm, named):
    with pytest.raises(BadMessage, match=named):
        BandFilter(MYOPIA, CAMERA, SETTINGS, wavelengths_nm=wavelengths_nm)


def test_wrong_arrays_are_named():
    with BandFilter(
        MYOPIA, CAMERA, SETTINGS, wavelengths_nm=[500.0, 600.0], engine="native"
    ) as band_filter:
        bands, depth_m = scene(3)
        for wrong in (bands, np.zeros((*SHAPE, 2), np.uint8), [[0.0]]):
            with pytest.raises(BadMessage, match="height, width, 2"):
                band_filter.filter(wrong, depth_m, **STATE)
