"""The lens that is best for a scene, against closed forms and grids of lenses."""

import re
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from estimator.optics.prescription import Prescription, at_cornea, power_vector
from filter_service.camera import Camera
from filter_service.correcting import LensScene, best_lens, lens_scene, lens_search
from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.rgbd_view import RgbdView

WIDTH_PX, HEIGHT_PX = 64, 48
CAMERA = Camera.from_fov(1.6, width_px=WIDTH_PX, height_px=HEIGHT_PX)
SETTINGS = {"mode": "on-axis", "eye_model": "wavefront"}
BUILDER = {}

long = pytest.mark.long("searches of 15 lenses or more")


@pytest.fixture(scope="module", autouse=True)
def builder():
    """A builder for all searches."""
    with ExitStack() as closing:
        BUILDER["builder"] = open_inline_builder(closing, engine="native")
        yield
    BUILDER.clear()


def scene(distance_m=np.inf, *, pupil_mm=3.0, **options):
    """Return squares of random light at a distance."""
    squares = np.random.default_rng(7).random((HEIGHT_PX // 4, WIDTH_PX // 4, 1))
    color = np.kron(np.round(squares), np.ones((4, 4, 3))).astype(np.float32)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), distance_m, np.float32)
    view = RgbdView(color, depth_m, CAMERA.tangents, depth_kind="radial")
    return LensScene(view=view, pupil_diameter_mm=pupil_mm, **options)


def prescription(sphere_dpt, **more):
    return {"kind": "prescription", "sphere_dpt": sphere_dpt} | more


def found(profile, scenes, **options):
    return best_lens(profile, scenes, **{"settings": SETTINGS, **BUILDER, **options})


def power_of(lens):
    """Return the power vector of a lens at the cornea."""
    return np.array(power_vector(lens))


@long
@pytest.mark.parametrize(
    ("sphere_dpt", "lens"),
    [
        (-2.0, "spectacles"),
        pytest.param(-6.0, "spectacles", marks=pytest.mark.slow),
        pytest.param(3.0, "contact_lens", marks=pytest.mark.slow),
    ],
)
def test_a_spherical_eye_gets_its_prescription(sphere_dpt, lens):
    best = found(
        prescription(sphere_dpt), scene(), lens={"kind": lens}, has_cylinder=False
    )
    own = best.best.prescription
    assert own.vertex_mm == (12.0 if lens == "spectacles" else 0.0)
    assert best.has_converged
    assert np.isclose(at_cornea(own).sphere_dpt, sphere_dpt, atol=0.05)
    assert best.correction["sphere_dpt"] == own.sphere_dpt
    assert best.best.error_db == min(trial.error_db for trial in best.trials)
    assert best.gain_db > 3.0
    assert best.gain_over_start_db >= 0.0
    assert best.rounded.prescription.sphere_dpt % 0.25 == 0.0


@pytest.mark.slow
def test_an_astigmatic_eye_gets_its_cylinder_and_axis():
    eye = prescription(-1.0, cylinder_dpt=-1.5, axis_deg=20.0)
    best = found(eye, scene(), lens={"kind": "spectacles", "vertex_mm": 14.0})
    wanted = power_of(Prescription(-1.0, -1.5, 20.0))
    assert np.abs(power_of(best.best.prescription) - wanted).max() < 0.06
    assert best.best.prescription.vertex_mm == 14.0


OFFSETS_DPT = (-0.3, -0.15, -0.05, 0.05, 0.15, 0.3)


@long
def test_no_lens_of_a_grid_is_better():
    wavefront = {"2,0": 1.0, "4,0": 0.25, "6,0": -0.05}
    eye = {"kind": "zernike", "zernike_um": wavefront, "age_years": 60}
    eye |= {"pupil_diameter_mm": 5.0, "wavelength_nm": 555.0}
    of = scene(pupil_mm=5.0)
    best = found(eye, of, has_cylinder=False, measure="retina")

    def error_db_through(sphere_dpt):
        worn = {"kind": "spectacles", "vertex_mm": 12.0, "sphere_dpt": sphere_dpt}
        with EyeFilter(eye | {"correction": worn}, CAMERA, SETTINGS, **BUILDER) as own:
            seen = own.filter(
                of.view,
                pupil_diameter_mm=5.0,
                focus_dpt=0.0,
                output="linear",
                merge=False,
                bright_pixels=False,
                render_tolerance=0.0,
            )
        difference = seen.color - of.view.color
        return 10.0 * np.log10(np.mean(difference**2, dtype=np.float64))

    at_dpt = best.best.prescription.sphere_dpt
    assert np.isclose(error_db_through(at_dpt), best.best.error_db, atol=0.01)
    errors_db = [error_db_through(at_dpt + offset_dpt) for offset_dpt in OFFSETS_DPT]
    assert best.best.error_db <= min(errors_db) + 0.01
    assert min(errors_db[0], errors_db[-1]) > best.best.error_db + 0.1


@pytest.mark.slow
def test_accommodation_does_not_compensate_a_lens():
    young = found(prescription(-2.0, age_years=20), scene(), has_cylinder=False)
    old = found(prescription(-2.0, age_years=60), scene(), has_cylinder=False)
    assert young.best.prescription == old.best.prescription


@long
def test_reading_glasses_of_an_eye_that_does_not_accommodate():
    eye = prescription(0.0, age_years=60)
    near = scene(0.4)
    best = found(eye, near, lens={"vertex_mm": 0.0}, has_cylinder=False)
    # The lens is 3.05 mm in front of the pupil, from which distances are measured.
    wanted_dpt = 1.0 / (0.4 - 0.00305)
    assert np.isclose(best.best.prescription.sphere_dpt, wanted_dpt, atol=0.05)


@pytest.mark.slow
def test_far_and_near_share_a_lens_by_their_weights():
    eye = prescription(0.0, age_years=60)

    def sphere_dpt(weight):
        scenes = [scene(), scene(1.0, weight_ratio=weight)]
        return found(eye, scenes, has_cylinder=False).best.prescription.sphere_dpt

    powers = [sphere_dpt(weight) for weight in (1e-4, 1.0, 1e4)]
    assert -0.1 < powers[0] < 0.1
    assert powers[0] < powers[1] < powers[2]
    assert 0.9 < powers[2] < 1.1


@pytest.mark.slow
def test_an_eye_that_accommodates_needs_no_lens_for_the_near():
    eye = prescription(0.0, age_years=20)
    best = found(eye, [scene(), scene(0.5)], has_cylinder=False)
    assert abs(best.best.prescription.sphere_dpt) < 0.06


@pytest.mark.slow
def test_a_progressive_lens_gets_its_addition():
    eye = prescription(-1.0, age_years=60)
    scenes = [scene(), scene(0.5, gaze_deg=(0.0, -35.0))]
    lens = {"kind": "progressive", "vertex_mm": 12.0, "corridor_mm": 14.0}
    best = found(eye, scenes, lens=lens, has_cylinder=False)
    # Spectacles 12 mm before the cornea, for an object 0.5 m before the pupil.
    far_dpt = -1.0 / (1.0 - 0.012)
    needed_dpt = 1.0 / (0.5 - 0.01505)
    near = best.best.prescription.sphere_dpt + best.best.add_dpt
    assert np.isclose(best.best.prescription.sphere_dpt, far_dpt, atol=0.1)
    assert np.isclose(near, far_dpt + needed_dpt, atol=0.15)
    assert best.correction["add_dpt"] == best.best.add_dpt
    assert best.rounded.add_dpt % 0.25 == 0.0


@long
def test_what_another_eye_sees_needs_the_difference_of_their_lenses():
    best = found(
        prescription(-3.0, higher_order="none"),
        scene(),
        target_eye=prescription(-1.0, higher_order="none"),
        has_cylinder=False,
    )
    sphere_dpt = at_cornea(best.best.prescription).sphere_dpt
    assert np.isclose(sphere_dpt, -2.0, atol=0.06)
    assert best.after.shape == best.target.shape
    assert np.mean((best.after - best.target) ** 2) < 1e-4


@long
def test_progress_and_the_course_are_told():
    told = []
    best = found(
        prescription(-1.0),
        scene(),
        has_cylinder=False,
        measure="retina",
        on_progress=lambda fraction, stage: told.append((fraction, stage)),
    )
    assert len(best.trials) >= 7
    assert best.trials[0] == best.start
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert max(fractions[:-1]) < 1.0
    assert best.search_s > 0.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"lens": {"kind": "iol"}}, "lens.kind: it is 'iol'"),
        ({"lens": {"vertex_mm": 90.0}}, "correction.vertex_mm"),
        ({"measure": "l1"}, "measure: it is 'l1'"),
        ({"max_evaluations": 5}, "max_evaluations: it is 5"),
        ({"scenes": []}, "scenes: there are 0"),
        ({"scenes": ["far"]}, "scenes[0]: a str"),
        ({"scenes": scene(weight_ratio=-1.0)}, "scenes[0].weight_ratio: it is -1"),
        ({"scenes": scene(pupil_mm=20.0)}, "pupil_diameter_mm"),
    ],
)
def test_arguments_out_of_range_are_errors(change, said):
    given = {"scenes": scene()} | change
    with pytest.raises(ValueError, match=re.escape(said)):
        found(prescription(-1.0), given.pop("scenes"), **given)


def test_an_intraocular_lens_is_not_replaced():
    lens = {"kind": "iol", "design": "monofocal"}
    with pytest.raises(BadMessage, match="intraocular"):
        found({"kind": "preset", "name": "myopia", "correction": lens}, scene())


@pytest.mark.parametrize("offset_px", [(0.0, 0.0), (0.6, -0.3), (2.4, 1.7)])
def test_a_displaced_image_is_registered(offset_px):
    target = scene().view.color[..., 1]
    blurred = gaussian_filter(target, 1.2)
    moved = shift(blurred, offset_px, order=5, mode="nearest")
    found_px = lens_scene.displacement_px(moved, target)
    assert np.abs(found_px + offset_px).max() < 0.02


def test_a_uniform_image_has_no_displacement():
    plain = np.full((8, 9), 0.5, np.float32)
    assert not lens_scene.displacement_px(plain, plain + 0.1).any()


def test_each_distance_of_a_scene_has_its_focus():
    of = scene()
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32)
    depth_m[:, 20:40], depth_m[:, 40:] = 1.0, 0.5
    of = replace(of, view=replace(of.view, depth_m=depth_m))
    sight = lens_scene.Sight(of, "luminance")
    foci = list(sight.foci(can_focus=True))
    assert [focus_dpt for focus_dpt, _ in foci] == [0.0, 1.0, 2.0]
    assert [int(pixels[0].sum()) for _, pixels in foci] == [20, 20, 24]
    ((_, every),) = sight.foci(can_focus=False)
    assert every.all()


def test_lenses_are_rounded_to_the_nearest_mean_power():
    lens = lens_search.rounded_prescription(Prescription(-1.70, -0.64, 179.7, 12.0))
    assert lens == Prescription(-1.75, -0.75, 180.0, 12.0)
    lens = lens_search.rounded_prescription(Prescription(-1.13, -0.05, 3.2, 12.0))
    assert lens == Prescription(-1.25, 0.0, 3.0, 12.0)


def test_powers_at_the_pupil_are_those_of_the_lens():
    lens = Prescription(-4.5, -1.25, 35.0, 13.0)
    vector = power_vector(lens, depth_mm=3.05)
    back = lens_search.lens_from_power_vector(vector, vertex_mm=13.0)
    assert np.allclose(
        (back.sphere_dpt, back.cylinder_dpt, back.axis_deg), (-4.5, -1.25, 35.0)
    )
