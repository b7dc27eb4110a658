"""`ocufilter bands` as a person runs it: files, outputs, errors."""

import json

import numpy as np
import pytest

from estimator.color import lms_weights
from filter_service.band_files import read_bands, write_bands
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


@pytest.mark.parametrize(
    ("more", "named"),
    [
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
