"""`ocufilter psf` off axis, by every method, to JSON; and its refusals."""

import json

import numpy as np
import pytest

from estimator import load_profile, prepare_eye
from estimator.psf.compute import compute_psfs
from tests.commands import run_command
from tests.unit.test_wavefront_command import eye_file

VIEW = ["--pupil-mm", "3", "--wavelength-nm", "536", "--pixel-arcmin", "2"]

__all__ = ["eye_file"]  # a fixture


@pytest.fixture
def psf(tmp_path):
    """Facts and kernel of a successful call."""

    def call(*arguments):
        out = tmp_path / "psf.npy"
        ended = run_command("psf", *arguments, *VIEW, "-o", out, "--json")
        assert ended.returncode == 0, ended.stderr
        return json.loads(ended.stdout), np.load(out)

    return call


@pytest.fixture
def refusal(tmp_path):
    """Error line of a refused call."""

    def call(*arguments):
        ended = run_command("psf", *arguments, *VIEW, "-o", tmp_path / "psf.npy")
        assert ended.returncode == 2
        assert ended.stderr.count("\n") == 1
        return ended.stderr

    return call


def test_methods_agree_on_axis_and_are_named(psf):
    """Emmetropia lies in the domain of all but ray optics."""
    auto, kernel = psf("emmetropia")
    assert auto["method"] == "fourier"
    assert auto["pupil_ellipse"]["ratio"] == pytest.approx(1.0, abs=1e-4)
    assert auto["predicted_psnr_db"] == 54.0
    for method in ("fourier", "enz"):
        facts, other = psf("emmetropia", "--method", method)
        assert facts["method"] == method
        np.testing.assert_allclose(other, kernel, atol=1e-2 * kernel.max())
    facts, _ = psf("emmetropia", "--method", "geometric")
    assert facts["method"] == "geometric"
    assert facts["predicted_psnr_db"] < 50.0


def test_off_axis_the_eye_is_traced_through_its_elliptical_pupil(psf):
    on_axis, _ = psf("emmetropia")
    facts, kernel = psf("emmetropia", "--h-deg", 30, "--v-deg", 5)
    assert facts["pupil_ellipse"]["ratio"] == pytest.approx(0.88, abs=0.03)
    assert facts["h_deg"] == 30
    assert facts["blur_radius_px"] > 3.0 * on_axis["blur_radius_px"]
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
    dimmer, other = psf("emmetropia", "--h-deg", 30, "--v-deg", 5, "--stiles-crawford")
    assert dimmer["stiles_crawford"]
    assert not facts["stiles_crawford"]
    # The rim of the spot is the rim of the pupil: with it dimmed the spot is smaller.
    assert 0.5 * _spread_px(kernel) < _spread_px(other) < 0.99 * _spread_px(kernel)


@pytest.mark.parametrize(("h_deg", "v_deg"), [(30.0, 0.0), (-20.0, 10.0), (0.0, 0.0)])
def test_it_is_the_psf_of_frames(psf, h_deg, v_deg):
    """Without the periphery of people, 30 deg had a round spot along the other axis."""
    _, kernel = psf("emmetropia", "--h-deg", h_deg, "--v-deg", v_deg)
    eye, _ = prepare_eye(
        load_profile("emmetropia"), field_range_deg=((-31.0, 31.0), (-15.0, 15.0))
    )
    state = {"h_deg": h_deg, "v_deg": v_deg, "pupil_diameter_mm": 3.0}
    state |= {"accommodation_dpt": 0.0, "wavelength_nm": 536.0}
    wave = eye.wavefronts(**state, total_defocus_dpt=eye.total_defocus_dpt(**state))
    found = compute_psfs(
        wave.zernike_um,
        pupil_diameter_mm=wave.circle_diameter_mm[0],
        pupil_ellipse=wave.pupil_ellipse[0],
        wavelength_nm=536.0,
        pixel_pitch_mrad=np.radians(2.0 / 60.0) * 1e3,
    )[0].kernel
    margin_px = (len(kernel) - len(found)) // 2
    difference = kernel.copy()
    inside = slice(margin_px, len(kernel) - margin_px)
    difference[inside, inside] -= found
    assert np.abs(difference).sum() / 2.0 < 0.005


def _spread_px(kernel):
    """Mean distance of the light from its center."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    x, y = kernel.sum(0) @ offset, kernel.sum(1) @ offset
    return float((kernel * np.hypot(offset - x, offset[:, None] - y)).sum())


def test_surfaces_are_traced_too(eye_file, psf):
    facts, _ = psf(eye_file, "--v-deg", -20)
    assert facts["pupil_ellipse"]["ratio"] == pytest.approx(0.94, abs=0.03)
    assert "eye as given by its surfaces" in facts["notes"]


def test_enz_refuses_what_its_series_does_not_hold(refusal):
    assert "outside the domain" in refusal(
        "keratoconus", "--method", "enz", *["--h-deg", "40"]
    )


@pytest.mark.parametrize(
    ("option", "value"), [("--h-deg", "80"), ("--v-deg", "-76"), ("--focus-dpt", "-1")]
)
def test_views_out_of_range_are_refused(refusal, option, value):
    assert option in refusal("emmetropia", option, value)


def test_surfaces_in_one_state_do_not_accommodate(eye_file, psf):
    facts, _ = psf(eye_file, "--focus-dpt", 2)
    assert "nearer than the near point" in " ".join(facts["notes"])
