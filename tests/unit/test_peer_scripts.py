"""What the scripts of the peers compute themselves, without the peers."""

import sys
from argparse import Namespace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from estimator.profiles.parse import parse_profile
from filter_service.planning.grid import pixel_from_mrad
from tests.benchmarks import bench_peers, peer_gradients, peer_process
from tests.benchmarks.harness import Run
from tests.benchmarks.peer_deeplens_script import (
    kernel_side_px,
    lens_file,
    lens_numbers,
)
from tests.benchmarks.peer_optiland import EYE, eye_request
from tests.benchmarks.peer_optiland_script import (
    Camera,
    dense_image,
    hat,
    integrated,
    local_scale,
    pixel_weights,
)
from tests.benchmarks.peer_problem import NotInstalled
from tests.grid_specs import grid_spec
from tests.isetbio_psfs import (
    MRAD_PER_ARCMIN,
    moved_light,
    our_psf,
    published_psfs,
    zernike_term,
)

pytestmark = pytest.mark.tools

TANGENTS = (-0.27, 0.27, 0.15, -0.15)
CAMERA = Camera(TANGENTS, (36, 20))
RNG = np.random.default_rng(5)


def test_field_points_run_over_the_pixels_in_image_order():
    rows, columns = CAMERA.field_points((20, 36))
    assert rows[0] == pytest.approx(0.15 - CAMERA.pitch / 2)
    assert np.diff(rows) == pytest.approx(np.full(19, -CAMERA.pitch))
    assert np.diff(columns) == pytest.approx(np.full(35, CAMERA.pitch))


@pytest.mark.parametrize("direction_deg", [(0.0, 0.0), (15.0, 0.0), (-12.0, 7.0)])
def test_the_local_scale_is_that_of_our_images(direction_deg):
    camera = grid_spec(None, width_px=36, height_px=20, tangents=TANGENTS).camera
    h, v = np.radians(direction_deg)
    tangent_x, tangent_y = np.tan(h), np.tan(v) / np.cos(h)
    ours = pixel_from_mrad(camera, *direction_deg)
    # ours is about the pupil axes of the direction; areas do not depend on them
    theirs = local_scale(tangent_x, tangent_y) / CAMERA.pitch / 1000.0
    cosine = np.cos(h) * np.cos(v)
    assert np.linalg.det(theirs) * cosine == pytest.approx(
        abs(np.linalg.det(ours)), rel=1e-6
    )


def test_pixels_integrate_a_psf_at_its_place_and_upside_down():
    psf = np.zeros((61, 61))
    # 2 px to the right and 1 px up, at 6 samples per pixel
    psf[30 + 6, 30 + 12] = 3.0
    kernel = integrated(psf, CAMERA.pitch / 6, np.eye(2), CAMERA.pitch, 4)
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel[4 - 1, 4 + 2] == pytest.approx(1.0)
    wide = integrated(psf, CAMERA.pitch / 6, np.diag([1.25, 1.0]), CAMERA.pitch, 4)
    columns = wide.sum(axis=0) @ (np.arange(9) - 4)
    assert columns == pytest.approx(2.5, abs=1e-9)


def test_a_dense_image_is_a_convolution_where_the_psf_stays():
    channel = RNG.random((23, 31))
    kernel = RNG.random((5, 5))
    kernels = np.broadcast_to(kernel, (4, 6, 5, 5))
    assert hat(6, 31).sum(axis=0) == pytest.approx(np.ones(31))
    assert dense_image(channel, kernels) == pytest.approx(
        fftconvolve(channel, kernel, mode="same")
    )


def test_a_dense_image_blends_psfs_between_field_points():
    channel = np.zeros((9, 9))
    channel[4, 2] = 1.0
    kernels = np.zeros((2, 2, 3, 3))
    kernels[:, 0, 1, 1], kernels[:, 1, 1, 2] = 1.0, 1.0
    image = dense_image(channel, kernels)
    assert image[4, 2] == pytest.approx(0.75)
    assert image[4, 3] == pytest.approx(0.25)


def test_the_eye_for_optiland_has_the_surfaces_and_indices_of_its_color():
    eye = parse_profile(EYE).surfaces.relaxed
    request = eye_request(eye, 543.0)
    assert [s["radius_mm"] for s in request["surfaces"]] == [7.72, 6.5, 10.2, -6.0]
    assert request["surfaces"][2]["index_after"] == pytest.approx(1.4222, abs=2e-4)
    assert request["retina"]["z_mm"] == 23.9203
    tilted = parse_profile(
        {
            "kind": "surfaces",
            "surfaces": [
                {
                    "radius_mm": 6.0,
                    "z_mm": 0.0,
                    "medium_after": "vitreous",
                    "tilt_deg": [1.0, 0.0],
                }
            ],
            "stop_z_mm": 3.0,
            "retina": {"radius_mm": 12.0, "z_mm": 24.0},
        }
    )
    with pytest.raises(ValueError, match="only centered conics"):
        eye_request(tilted.surfaces.relaxed, 543.0)


@pytest.mark.parametrize("focus_dpt", [6.0, 0.5, -1.0])
def test_a_thin_lens_blurs_by_the_angle_of_the_eye(focus_dpt):
    numbers = lens_numbers(focus_dpt, 5.0, CAMERA.pitch, CAMERA.size_px)
    width_mm, height_mm = numbers["sensor_size"]
    assert width_mm * 20 == height_mm * 36  # DeepLens compares exactly
    f, focus_mm = numbers["foclen"], numbers["focus_mm"]
    distance_mm = 1000.0 / 2.0
    circle_mm = abs(distance_mm - focus_mm) / distance_mm
    circle_mm *= f**2 / (numbers["fnum"] * (focus_mm - f))
    defocus_dpt = 2.0 - max(focus_dpt, 1e-3)
    angle = 5e-3 * abs(defocus_dpt)
    assert circle_mm / (width_mm / 36) == pytest.approx(angle / CAMERA.pitch, rel=1e-5)


def test_the_lens_file_has_the_stop_at_its_surface():
    eye = eye_request(parse_profile(EYE).surfaces.relaxed, 543.0)
    given = {"stop_radius_mm": 2.2, "pixel_mm": 0.01, "side_px": 25}
    rows = lens_file(**eye, **given)["surfaces"]
    assert [row["is_aperture"] for row in rows] == [False, False, True, False]
    assert rows[2]["r"] == 2.2
    assert sum(row["d_next"] for row in rows) == pytest.approx(23.9203)
    with pytest.raises(ValueError, match="at the vertex of a surface"):
        lens_file(**{**eye, "stop_z_mm": 3.0}, **given)


def test_kernels_hold_the_circle_and_have_a_center():
    assert kernel_side_px(0.0, 0.01) == 1
    assert kernel_side_px(0.06, 0.01) == 7
    assert kernel_side_px(0.061, 0.01) == 9


def summed_psf(published, step_mm):
    """PSF at the published samples: a sum over a raster of the pupil."""
    radius_mm = published.pupil_diameter_mm / 2.0
    count, side = int(radius_mm / step_mm) + 1, published.psf.shape[0] // 2
    along_mm = np.arange(-count, count + 1) * step_mm
    x, y = np.meshgrid(along_mm, along_mm)
    wave_um = sum(
        value * zernike_term(j, x / 3.0, y / 3.0)  # measured over 6 mm
        for j, value in enumerate(published.zernike_um, 1)
    )
    field = np.exp(2j * np.pi / 0.55 * wave_um) * (np.hypot(x, y) <= radius_mm)
    angle_mrad = np.arange(-side, side + 1) * published.sample_arcmin * MRAD_PER_ARCMIN
    turns = np.exp(-2j * np.pi / 0.55 * np.outer(angle_mrad, along_mm))
    light = np.abs(turns @ field @ turns.T)[::-1] ** 2  # rows grow downward
    return light / light.sum()


@pytest.mark.parametrize("number", range(4))
def test_our_psfs_are_those_of_isetbio(number):
    published = published_psfs()[number]
    psf, _ = our_psf(published)
    assert moved_light(psf, summed_psf(published, 0.03)) <= 0.015
    # their pupil is a raster of 37 samples, too few with 2 dpt: an exact sum is as far
    most = 0.065 if "+2 dpt" in published.label else 0.03
    assert moved_light(psf, published.psf) <= most


def test_printed_figures_say_that_they_are_not_measured():
    for row in bench_peers.printed_rows():
        assert row.n == 0
        assert row.setting == "not measured here"
        assert "The Visual Computer" in row.published


def test_missing_packages_are_listed_and_the_other_rows_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(peer_process, "PYTHON", tmp_path / "python")
    methods = [("peer", lambda: peer_process.require("optiland"), "", "")]
    monkeypatch.setattr(bench_peers, "gradient_methods", lambda: methods)
    run = Run(is_quick=True, options=Namespace(rows=["gradient", "printed"]))
    rows, details = bench_peers.measure(run)
    assert [row.method for row in rows] == ["light-gathering trees"]
    missing = {"method": "peer", "not_installed": "optiland (sh setup.sh peers)"}
    assert details["missing"] == [missing]
    assert details["packages"][0]["optiland"] is None


ANSWERS = """
import sys
sys.path.insert(0, {folder!r})
from peer_answers import answer_requests
def add(folder, a, b):
    print("a library prints")
    return {{"sum": a + b}}
def fail(folder):
    raise ValueError("no such eye")
answer_requests({{"add": add, "fail": fail}})
"""


def test_a_script_answers_requests_until_it_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(peer_process, "PYTHON", sys.executable)
    script = tmp_path / "script.py"
    folder = str(peer_process.ROOT / "tests" / "benchmarks")
    script.write_text(ANSWERS.format(folder=folder), encoding="utf-8")
    process = peer_process.PeerProcess(script)
    assert process.ask("add", a=1, b=2) == {"sum": 3}
    assert process.ask("add", a=2, b=2) == {"sum": 4}
    with pytest.raises(RuntimeError, match="no such eye"):
        process.ask("fail")
    process.close()


def test_a_missing_environment_is_named_with_the_command_that_makes_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(peer_process, "PYTHON", tmp_path / "python")
    with pytest.raises(NotInstalled, match=r"^optiland \(sh setup.sh peers\)$"):
        peer_process.require("optiland")


def test_rays_meet_behind_the_ellipsoid_that_focuses_them(monkeypatch):
    """A conic constant of -1 / n^2 focuses parallel rays at n R / (n - 1)."""
    index, radius_mm = 1.336, 7.8
    surface = {
        "radius_mm": radius_mm,
        "conic_constant": -1.0 / index**2,
        "z_mm": 0.0,
        "index_after": index,
    }
    heights_mm = np.linspace(0.1, 3.0, 7)
    focus_mm = index * radius_mm / (index - 1.0)
    monkeypatch.setattr(peer_gradients, "RETINA_MM", focus_mm)
    assert peer_gradients.traced_heights([surface], heights_mm) == pytest.approx(
        np.zeros(7), abs=1e-12
    )
    monkeypatch.setattr(peer_gradients, "RETINA_MM", 0.5 * focus_mm)
    found = peer_gradients.traced_heights([surface], np.array([1e-4]))
    assert found == pytest.approx([0.5e-4], rel=1e-6)


def test_samples_of_a_psf_are_weighted_with_the_blob_of_their_pixels():
    blob = np.array([1.0, 3.0, 2.0])
    weights = pixel_weights(blob, pitch=2.0, step=0.5, size=16)
    assert weights.sum() * 0.5 == pytest.approx(blob.sum() * 2.0)
    assert weights[8] == pytest.approx(3.0)  # the sample on the axis
    assert weights[6] == pytest.approx((1.0 + 3.0) / 2.0)  # at the edge of a pixel
    assert weights[[0, 15]] == pytest.approx([0.0, 0.0])
