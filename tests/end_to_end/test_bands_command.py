"""`ocufilter bands` as a person runs it: files, outputs, errors."""

import json

import numpy as np
import pytest

from estimator.color import lms_weights
from filter_service.band_files import read_bands, write_bands
from filter_service.displays import (
    DISPLAYS,
    MEASURED,
    display_spectra,
    primaries_of_spectra,
)
from filter_service.image_files import write_image
from tests.commands import run_command

pytestmark = pytest.mark.clients

NM = np.array([450.0, 550.0, 650.0])
EYE = '{"kind": "prescription", "sphere_dpt": -1}'
PLAIN = ("--mode", "on-axis", "--eye-model", "wavefront")


@pytest.fixture
def arguments(tmp_path):
    """Return the arguments of a run on a small image with wavelengths."""
    bands = np.random.default_rng(0).random((20, 30, 3), np.float32)
    write_bands(tmp_path / "scene.hdr", bands, wavelengths_nm=NM)
    given = ("--bands", tmp_path / "scene.hdr", "--distance-m", 2, "--fov-deg", 2)
    return ("bands", *given, "--profile", EYE, *PLAIN)


@pytest.mark.long("builds two eyes")
def test_cone_signals_are_those_of_the_written_bands(arguments, tmp_path):
    finished = run_command(*arguments, "-o", tmp_path / "seen.hdr", "--json")
    assert (finished.returncode, finished.stderr) == (0, "")
    told = json.loads(finished.stdout)
    assert told["wavelengths_nm"] == NM.tolist()
    seen = read_bands(tmp_path / "seen.hdr")
    assert np.array_equal(seen.wavelengths_nm, NM)
    assert seen.bands.std() < 0.25  # blurred noise
    finished = run_command(
        *arguments,
        *("--as", "lms", "--lens-age-years", 60, "-o", tmp_path / "cones.npy"),
    )
    assert finished.returncode == 0
    expected = seen.bands @ lms_weights(NM, age_years=60.0)
    np.testing.assert_allclose(np.load(tmp_path / "cones.npy"), expected, rtol=1e-5)


@pytest.fixture
def picture(tmp_path):
    """Return the arguments of a run on a uniform white picture."""
    write_image(tmp_path / "white.png", np.full((20, 30, 3), 255, np.uint8))
    given = ("--color", tmp_path / "white.png", "--distance-m", 2, "--fov-deg", 2)
    return ("bands", *given, "--profile", EYE, *PLAIN)


@pytest.mark.long("builds an eye three times")
def test_white_pictures_have_the_signals_of_the_spectra_of_the_display(
    picture, tmp_path
):
    """Yellowing sets the age of the lens, and dims nothing before the fundamentals."""
    old = json.loads(EYE) | {"yellowing": "seen", "age_years": 70}
    for more, name, age_years in (
        (("--profile", EYE), "common", 32.0),
        (("--profile", json.dumps(old), "--display", "oled"), "oled", 70.0),
    ):
        finished = run_command(*picture, *more, "-o", tmp_path / "seen.npy", "--json")
        assert (finished.returncode, finished.stderr) == (0, "")
        told = json.loads(finished.stdout)
        assert told["spectra"] == MEASURED[name]
        assert told["wavelengths_nm"] == list(DISPLAYS[name])
        assert (told["as"], told["lens_age_years"]) == ("lms", age_years)
        at_nm, spectra = display_spectra(name)
        white = spectra.sum(axis=1) @ lms_weights(at_nm, age_years=age_years)
        found = np.load(tmp_path / "seen.npy")
        np.testing.assert_allclose(found[8:12, 10:20] / white, 1.0, rtol=1e-5)
    # A file of spectra, which also sets the wavelengths of the PSFs.
    rows = np.column_stack([at_nm, 5.0 * spectra])
    np.savetxt(tmp_path / "oled.csv", rows, delimiter=",")
    arguments = ("--spectra", tmp_path / "oled.csv", "--as", "xyz", "--json")
    finished = run_command(*picture, *arguments, "-o", tmp_path / "seen.npy")
    assert finished.returncode == 0, finished.stderr
    expected_nm, _ = primaries_of_spectra(at_nm, spectra)
    told = json.loads(finished.stdout)
    np.testing.assert_allclose(told["wavelengths_nm"], expected_nm, atol=0.06)
    luminance = np.load(tmp_path / "seen.npy")[10, 15, 1]
    assert luminance == pytest.approx(1.0, abs=1e-5)


def test_spectra_without_light_are_refused(picture, tmp_path):
    (tmp_path / "dark.csv").write_text("400,0,0,0\n500,0,0,0\n600,0,0,0\n")
    dark = ("--spectra", tmp_path / "dark.csv")
    finished = run_command(*picture, *dark, "-o", tmp_path / "seen.npy")
    assert finished.returncode == 2
    assert "--spectra" in finished.stderr
    assert "independent colors" in finished.stderr


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--as", "bands"), "allowed: lms, xyz"),
        (("--wavelengths-nm", "400:700:100"), "not allowed with --color"),
        (("--bands", "scene.hdr"), "given together"),
        (("--display", "620,530,455"), "--spectra FILE"),
        (("--spectra", "none.csv"), "none.csv"),
        (("--spectra", "x.csv", "--display", "crt"), "not allowed with --spectra"),
    ],
)
def test_wrong_options_of_pictures_are_named(picture, tmp_path, more, named):
    finished = run_command(*picture, *more, "-o", tmp_path / "seen.npy")
    assert finished.returncode == 2
    assert named in finished.stderr
    assert not (tmp_path / "seen.npy").exists()


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--spectra", "x.csv"), "not allowed with --bands"),
        (("--wavelengths-nm", "400:700:0"), "first:last:step"),
        (("--wavelengths-nm", "400:700:100"), "4 wavelengths; allowed: 3"),
        (("--wavelengths-nm", "300,500,600"), "300 nm"),
        (("--lens-age-years", "90"), "20 to 80"),
        (("--field-size-deg", "11"), "1 to 10"),
    ],
)
def test_wrong_options_are_named(arguments, tmp_path, more, named):
    finished = run_command(*arguments, *more, "-o", tmp_path / "seen.npy")
    assert finished.returncode == 2
    assert named in finished.stderr
    assert not (tmp_path / "seen.npy").exists()
