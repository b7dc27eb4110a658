"""Straylight and absorption: published functions, brute force, and what stays."""

from types import SimpleNamespace

import numpy as np
import pytest

from estimator.media import (
    CATARACTS,
    LOG_S_RANGE,
    Straylight,
    channel_gains,
    cie_glare_per_sr,
    media_density,
)
from estimator.profiles.parse import ProfileError, parse_profile
from filter_service.camera import Camera
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.media_effects import (
    MediaEffects,
    add_haze,
    begin_through_media,
    encoded,
)
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests import human_data

WIDE = Camera.from_fov(50.0, width_px=640, height_px=360)


def hazed(color, camera, straylight):
    color = color.copy()
    add_haze(color, camera, straylight)
    return color


# ----- the functions


@pytest.mark.parametrize("age_years", [0.0, 25.0, 50.0])
def test_the_glare_function_is_a_point_spread_function(age_years):
    angles_deg = np.geomspace(1e-4, 90.0, 100_000)
    per_sr = cie_glare_per_sr(angles_deg, age_years=age_years)
    rings_sr = 2.0 * np.pi * np.sin(np.radians(angles_deg))
    whole = np.trapezoid(per_sr * rings_sr, np.radians(angles_deg))
    assert whole == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("age_years", [25.0, 70.0])
@pytest.mark.parametrize("pigmentation", [0.0, 0.5, 1.2])
@pytest.mark.parametrize("angle_deg", [1.0, 3.0, 10.0, 30.0])
def test_the_glare_function_is_near_the_disability_glare_equation(
    angle_deg, pigmentation, age_years
):
    """CIE 146:2002, general equation, 0.1 to 100 deg: an engineer's fit to the same."""
    lens = (5.0 / angle_deg**2 + 0.1 * pigmentation / angle_deg) * (
        1.0 + (age_years / 62.5) ** 4
    )
    law = 10.0 / angle_deg**3 + lens + 0.0025 * pigmentation
    found = cie_glare_per_sr(angle_deg, age_years=age_years, pigmentation=pigmentation)
    assert np.log10(found / law) == pytest.approx(0.0, abs=0.13)


@pytest.mark.parametrize("age_years", [20.0, 45.0, 65.0, 77.0])
def test_the_straylight_parameter_is_that_of_measured_drivers(age_years):
    """Its standard deviation between people is 0.10."""
    eye = Straylight(age_years)
    for angle_deg, limit in ((7.0, 1e-9), (10.0, 0.06)):
        found = np.log10(angle_deg**2 * eye.per_sr(angle_deg))
        norm = human_data.drivers_log_s(angle_deg, age_years)
        assert found == pytest.approx(norm, abs=limit)
    assert eye.age_log_s == pytest.approx(human_data.drivers_log_s(7.0, age_years))


@pytest.mark.parametrize("pigmentation", [0.0, 1.0])
def test_pigment_changes_straylight_as_in_the_glare_function(pigmentation):
    brown, other = (Straylight(40.0, pigment) for pigment in (0.5, pigmentation))
    change = other.per_sr(7.0) - brown.per_sr(7.0)
    expected = cie_glare_per_sr(7.0, age_years=40.0, pigmentation=pigmentation)
    expected -= cie_glare_per_sr(7.0, age_years=40.0)
    assert change == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("age_years", [25.0, 70.0])
def test_beyond_a_degree_the_scatter_is_the_glare_function(age_years):
    """And the drivers' excess: 14 and 30 % of its light at 7 deg."""
    angles_deg = np.linspace(1.0, 20.0, 200)
    found = Straylight(age_years).per_sr(angles_deg)
    expected = cie_glare_per_sr(angles_deg, age_years=age_years)
    excess = 10.0 ** human_data.drivers_log_s(7.0, age_years)
    excess -= 49.0 * cie_glare_per_sr(7.0, age_years=age_years)
    expected += excess / angles_deg**2
    assert np.abs(np.log10(found / expected)).max() < 0.02


@pytest.mark.parametrize("kind", CATARACTS)
def test_a_cataract_has_its_straylight_parameter(kind):
    found = Straylight(log_s=CATARACTS[kind])
    assert np.log10(49.0 * found.per_sr(7.0)) == pytest.approx(CATARACTS[kind])
    assert 0.2 < found.fraction < 0.45


def test_the_ageing_lens_absorbs_what_pokorny_found():
    """Change of density from 32 to 70 years, Pokorny, Smith & Lutze 1987."""
    for nm, base, young in ((450.0, 0.295, 0.005), (550.0, 0.093, 0.0)):
        expected = base * (1.56 + 0.0667 * 10.0) + young - (base + young)
        found = media_density(nm, age_years=70.0) - media_density(nm, age_years=32.0)
        assert found == pytest.approx(expected, abs=0.06)


def test_gains_of_the_reference_are_one_and_adapted_white_keeps_its_luminance():
    display_nm = (618.0, 536.0, 453.0)
    same = channel_gains(display_nm, age_years=32.0, yellowing="seen")
    assert same == pytest.approx([1.0, 1.0, 1.0])
    old = channel_gains(display_nm, age_years=75.0, yellowing="adapted")
    assert old @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0)
    assert old[0] > old[1] > old[2]
    with pytest.raises(ValueError, match="seen, adapted"):
        channel_gains(display_nm, age_years=75.0, yellowing="yes")


# ----- over a picture


def angle_between_deg(camera, first, second):
    left, right, up, down = camera.tangents

    def ray(x, y):
        u = left + (right - left) * (x + 0.5) / camera.width_px
        v = up + (down - up) * (y + 0.5) / camera.height_px
        ray = np.stack([u, v, -np.ones_like(u)], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    return np.degrees(np.arccos(np.clip((ray(*first) * ray(*second)).sum(-1), -1, 1)))


def lamp(camera, x, y, light=1e6):
    color = np.zeros((camera.height_px, camera.width_px, 3), np.float32)
    color[y, x] = light
    return color


@pytest.mark.parametrize("straylight", [Straylight(25.0), Straylight(70.0, 1.0)])
@pytest.mark.parametrize("angle_deg", [1.0, 2.0, 5.0, 10.0, 20.0])
def test_light_about_a_lamp_is_that_of_the_function(straylight, angle_deg):
    x, y, light = 320, 180, 1e6
    seen = hazed(lamp(WIDE, x, y, light), WIDE, straylight)
    columns = np.arange(x + 1, WIDE.width_px).astype(float)
    angles_deg = angle_between_deg(
        WIDE, (np.array([x]), np.array([y])), (columns, np.full(columns.size, float(y)))
    )
    nearest = int(np.argmin(np.abs(angles_deg - angle_deg)))
    pixel_sr = np.prod(np.array(WIDE.pixel_pitch_mrad) / 1e3)
    found = seen[y, x + 1 + nearest, 1] / (light * pixel_sr)
    per_sr = float(straylight.per_sr(angles_deg[nearest]))
    assert np.log10(found / per_sr) == pytest.approx(0.0, abs=0.1)


def test_scattered_light_is_that_of_the_direct_sum(rng):
    """Every pixel to every other over the true angles, on a small picture.

    Its pixels are larger than cells usually are: 3 % is what cells leave between them.
    """
    width, height, sub = 28, 24, 3
    camera = Camera.from_fov(16.0, width_px=width, height_px=height)
    straylight = Straylight(60.0)
    blocks = rng.random((height // 6, width // 4, 3)).astype(np.float32) ** 4
    color = np.kron(blocks, np.ones((6, 4, 1), np.float32))
    x, y = (a.ravel().astype(float) for a in np.meshgrid(range(width), range(height)))
    pixel_sr = np.prod(np.array(camera.pixel_pitch_mrad) / 1e3)
    inside = (np.arange(sub) + 0.5) / sub - 0.5
    spread = 0.0
    for dx in inside:
        for dy in inside:
            points = (x[None] + dx, y[None] + dy)
            angles_deg = angle_between_deg(camera, (x[:, None], y[:, None]), points)
            spread = spread + straylight.per_sr(angles_deg) / sub**2
    middle = (np.array([(width - 1) / 2]), np.array([(height - 1) / 2]))
    off_axis = np.radians(angle_between_deg(camera, middle, (x, y)))
    spread = spread * pixel_sr * np.cos(off_axis) ** 3  # of a pixel in a pinhole
    direct = spread @ color.reshape(-1, 3)
    border = np.concatenate([color[0], color[-1], color[:, 0], color[:, -1]])
    outside = (straylight.fraction - spread.sum(axis=1))[:, None]
    kept = (1.0 - straylight.fraction) * color.reshape(-1, 3)
    scattered = direct + outside * border.mean(axis=0)
    found = hazed(color, camera, straylight).reshape(-1, 3) - kept
    assert np.std(scattered) > 0.002
    assert np.sqrt(np.mean((found - scattered) ** 2)) < 0.04 * scattered.mean()


@pytest.mark.parametrize("fov_deg", [2.0, 50.0, 100.0])
def test_an_even_picture_stays_what_it_is(fov_deg):
    camera = Camera.from_fov(fov_deg, width_px=90, height_px=70)
    color = np.full((70, 90, 3), 0.37, np.float32)
    seen = hazed(color, camera, Straylight(70.0))
    assert seen == pytest.approx(0.37, rel=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 1)])
def test_the_smallest_pictures_are_finite(size):
    camera = Camera.from_fov(10.0, width_px=size[0], height_px=size[1])
    color = np.ones((size[1], size[0], 3), np.float32)
    seen = hazed(color, camera, Straylight())
    np.testing.assert_allclose(seen, 1.0, rtol=1e-4)


def test_light_scales():
    first = hazed(lamp(WIDE, 50, 300, 1.0), WIDE, Straylight())
    second = hazed(lamp(WIDE, 50, 300, 4096.0), WIDE, Straylight())
    np.testing.assert_allclose(second, 4096.0 * first, rtol=1e-4, atol=1e-9)


def test_bytes_are_those_of_the_srgb_curve():
    light = np.linspace(-0.1, 1.2, 70_001).astype(np.float32)
    color = np.stack([light] * 3, axis=-1)[None]
    clipped = np.clip(light.astype(float), 0.0, 1.0)
    curve = np.where(
        clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055
    )
    off = encoded(color, "srgb8")[0, :, 0].astype(int) - np.round(255.0 * curve)
    assert np.abs(off).max() <= 1
    assert np.mean(off != 0) < 0.01


def test_halves_never_become_infinite():
    color = np.array([[[-1e6, 0.25, 1e6]]], np.float32)
    assert encoded(color, "linear16").tolist() == [[[-65504.0, 0.25, 65504.0]]]


# ----- through the filter


class Glass:
    """An engine that leaves every picture as it is."""

    def begin(self, request):
        from filter_service.rendering.engine import ViewResult

        assert request.output == "linear"
        return lambda: ViewResult(
            color=request.view.color.astype(np.float32),
            stage_times_ms=request.times.ms,
            state=request.state,
        )


def test_the_filter_adds_what_the_profile_asks_for_and_tells_its_time():
    profile = parse_profile(
        {
            "kind": "preset",
            "name": "emmetropia",
            "age_years": 70,
            "straylight": {"pigmentation": 1.0},
            "yellowing": "seen",
        }
    )
    view = RgbdView(
        lamp(WIDE, 100, 100, 10.0), np.ones((360, 640), np.float32), WIDE.tangents
    )
    settings = SimpleNamespace(diffraction=False)
    store = SimpleNamespace(spec=SimpleNamespace(settings=settings), eye=None)
    request = ViewRequest(view, SimpleNamespace(store=store), State(4.0, 0.0))
    effects = MediaEffects.of(profile, "common")
    found = begin_through_media(Glass(), request, effects)()
    red, _, blue = found.color[100, 110]
    assert red > 1.5 * blue > 0.0
    assert found.stage_times_ms["media_ms"] > 0.0


@pytest.mark.parametrize("age_years", [0.0, 90.0])
@pytest.mark.parametrize("pigmentation", [0.0, 1.2])
def test_no_eye_scatters_more_light_than_there_is(age_years, pigmentation):
    for log_s in LOG_S_RANGE:
        eye = Straylight(age_years, pigmentation, log_s)
        assert 0.0 < eye.fraction < 0.96
    body = {"kind": "preset", "name": "cataract", "straylight": {"log_s": 2.2}}
    with pytest.raises(ProfileError, match=r"1\.9"):
        parse_profile(body)


def test_most_profiles_ask_for_nothing():
    for name in ("emmetropia", "keratoconus", "myopia"):
        profile = parse_profile({"kind": "preset", "name": name})
        assert MediaEffects.of(profile, "common") is None
    cataract = parse_profile({"kind": "preset", "name": "cataract"})
    assert cataract.straylight.log_s == CATARACTS["nuclear"]
    clear = parse_profile({"kind": "preset", "name": "cataract", "straylight": None})
    assert MediaEffects.of(clear, "common") is None


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ({"straylight": {"log_s": 9.0}}, "straylight.log_s"),
        ({"straylight": {"pigmentation": -1}}, "straylight.pigmentation"),
        ({"straylight": {"cataract": "bad"}}, "straylight.cataract"),
        ({"straylight": {"cataract": "nuclear", "log_s": 1.2}}, "straylight.log_s"),
        ({"straylight": {"haze": 1}}, "straylight.haze"),
        ({"straylight": 3}, "straylight"),
        ({"yellowing": "seen"}, "age_years"),
        ({"yellowing": "very", "age_years": 70}, "yellowing"),
    ],
)
def test_wrong_media_are_refused_by_name(more, field):
    with pytest.raises(ProfileError, match=field):
        parse_profile({"kind": "preset", "name": "myopia", **more})
