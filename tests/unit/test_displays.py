"""The wavelengths that stand for the primaries of displays."""

import numpy as np
import pytest

from clients.commands.options import display_of_file
from estimator.optics.units import RGB_WAVELENGTHS_NM
from filter_service.displays import (
    DISPLAYS,
    MEASURED,
    WIDTHS_NM,
    display_spectra,
    display_wavelengths_nm,
    display_widths_nm,
    matching_functions,
    primaries_of_spectra,
    primary_shares,
)
from filter_service.errors import BadMessage
from filter_service.settings import FilterSettings
from tests.grid_specs import grid_spec
from tests.reference.display_pictures import (
    errors_db,
    measured_displays,
    single_picture,
    true_picture,
    wide_picture,
)

AT_NM = np.arange(400.0, 701.0, 5.0)


def lines(*centers_nm, width_nm=4.0):
    """Narrow primaries (n, 3)."""
    away = (AT_NM[:, None] - np.array(centers_nm)) / width_nm
    return np.exp(-0.5 * away**2)


def test_matching_functions_are_those_of_cie_1931():
    # x, y, z of the 1931 observer at four wavelengths, and where y is highest
    published = {
        450.0: (0.3362, 0.0380, 1.7721),
        500.0: (0.0049, 0.3230, 0.2720),
        550.0: (0.4334, 0.9950, 0.0087),
        600.0: (1.0622, 0.6310, 0.0008),
    }
    ours = matching_functions(np.array(list(published)))
    assert ours == pytest.approx(np.array(list(published.values())), abs=0.04)
    assert AT_NM[matching_functions(AT_NM)[:, 1].argmax()] == pytest.approx(555, abs=5)


def test_all_light_of_a_primary_is_seen_as_that_primary():
    shares = primary_shares(AT_NM, lines(620, 530, 455, width_nm=20.0))
    assert shares.sum(axis=2) == pytest.approx(np.eye(3), abs=1e-12)


def test_narrow_primaries_are_found_where_they_are():
    found, widths_nm = primaries_of_spectra(AT_NM, lines(638, 521, 459))
    assert found == pytest.approx((638, 521, 459), abs=1.0)
    assert widths_nm == pytest.approx((4.0, 4.0, 4.0), abs=1.5)


@pytest.mark.parametrize("spectra", [np.ones((61, 2)), np.ones((61, 3))])
def test_spectra_that_are_no_three_colors_are_refused(spectra):
    with pytest.raises(ValueError, match="spectra"):
        primaries_of_spectra(AT_NM, spectra)


def test_both_packages_mean_the_same_by_default():
    assert DISPLAYS["common"] == RGB_WAVELENGTHS_NM


def test_a_display_is_a_name_or_three_wavelengths():
    assert display_wavelengths_nm("oled") == DISPLAYS["oled"]
    assert display_wavelengths_nm("640, 525.5,450") == (640.0, 525.5, 450.0)
    spec = spec_of(display="638,521,459")
    assert spec.channel_wavelengths_nm == pytest.approx([638, 521, 459])
    assert spec.primary_wavelengths_nm == pytest.approx(np.array([[638, 521, 459]]))


def spec_of(**settings):
    return grid_spec(
        width_px=8, height_px=8, tangents=(-0.1, 0.1, 0.1, -0.1), **settings
    )


def test_a_display_may_have_widths():
    assert display_widths_nm("oled") == WIDTHS_NM["oled"]
    assert display_wavelengths_nm("640:9,525.5,450:0") == (640.0, 525.5, 450.0)
    assert display_widths_nm("640:9,525.5,450:0") == (9.0, WIDTHS_NM["common"][1], 0.0)
    spec = spec_of(display="640:9,525.5:20,450:0", wide_primaries=True)
    assert spec.primary_wavelengths_nm == pytest.approx(
        np.array([[631.0, 505.5, 450.0], [649.0, 545.5, 450.0]])
    )
    every = [450.0, 505.5, 525.5, 545.5, 631.0, 640.0, 649.0]
    assert spec.traced_wavelengths_nm == pytest.approx(every)
    gray = spec_of(wide_primaries=True, chromatic=False)
    assert gray.primary_wavelengths_nm.shape == (1, 3)


@pytest.mark.parametrize(
    "display",
    [
        *("plasma", "", "620,530", "620,530,200", "620,530,nan", "a,b,c"),
        *("620:99,530,450", "620:-1,530,450", "620:1:2,530,450", "620:,530,450"),
    ],
)
def test_what_is_no_display_is_refused_by_name(display):
    with pytest.raises(BadMessage, match="display") as caught:
        FilterSettings(display=display)
    assert caught.value.field == "display"
    assert "oled" in caught.value.allowed


@pytest.mark.parametrize("name", list(measured_displays()))
def test_one_wavelength_a_primary_stands_for_a_measured_display(name):
    at_nm, power = measured_displays()[name]
    truth = true_picture(at_nm, power, 0.0)
    own, common, paper = (
        errors_db(single_picture(wavelengths_nm, 0.0), truth)
        for wavelengths_nm in (
            primaries_of_spectra(at_nm, power)[0],
            DISPLAYS["common"],
            DISPLAYS["paper"],
        )
    )
    assert own[0] > 51.0
    assert own[1] > 48.0
    assert common[0] > 50.5
    assert common[1] > 47.5
    assert common[1] > paper[1] + 1.0


@pytest.mark.parametrize("name", list(measured_displays()))
def test_two_wavelengths_a_primary_stand_for_it_better(name):
    at_nm, power = measured_displays()[name]
    truth = true_picture(at_nm, power, 0.0)
    own = errors_db(wide_picture(*primaries_of_spectra(at_nm, power), 0.0), truth)
    common = errors_db(
        wide_picture(DISPLAYS["common"], WIDTHS_NM["common"], 0.0), truth
    )
    assert own[0] > 53.0
    assert own[1] > 51.0
    assert common[0] > 51.0
    assert common[1] > 50.0


@pytest.mark.parametrize("name", list(MEASURED))
def test_measured_spectra_have_the_wavelengths_and_the_white_of_their_name(name):
    found = display_spectra(name)
    nm, _ = primaries_of_spectra(*found)
    assert nm == pytest.approx(DISPLAYS[name], abs=6.5)
    matching = matching_functions(found.wavelengths_nm)[:, 1]
    luminance = 10.0 * (found.spectra.sum(axis=1) @ matching)
    equal_energy = matching_functions(np.arange(360.0, 831.0))[:, 1].sum()
    assert luminance / equal_energy == pytest.approx(1.0, abs=0.01)


def test_displays_without_spectra_are_named():
    with pytest.raises(BadMessage, match=r"'paper'.*allowed: common, lcd, oled, crt"):
        display_spectra("paper")


def test_a_command_takes_spectra_from_a_file(tmp_path):
    at_nm, power = measured_displays()["OLED (Sony)"]
    path = tmp_path / "oled.csv"
    rows = (f"{nm:g},{r},{g},{b}" for nm, (r, g, b) in zip(at_nm, power, strict=True))
    path.write_text("nm,red,green,blue\n" + "\n".join(rows) + "\n", encoding="utf-8")
    display = display_of_file(str(path))
    expected_nm, expected_widths_nm = primaries_of_spectra(at_nm, power)
    assert display_wavelengths_nm(display) == pytest.approx(expected_nm, abs=0.06)
    assert display_widths_nm(display) == pytest.approx(expected_widths_nm, abs=0.06)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("400,1,2\n410,1,2\n", "spectra"),
        ("400,a,2,3\n", "four numbers"),
        ("400,1,2,3\n420,1,2,3\n430,1,3,3\n", "even steps"),
        ("", "four numbers"),
    ],
)
def test_a_file_that_holds_no_spectra_is_refused_by_name(tmp_path, text, said):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=said):
        display_of_file(str(path))
