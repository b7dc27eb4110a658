"""Lenses that people wear: closed forms, their true profiles, and published ones."""

import numpy as np
import pytest

from estimator.acuity import acuity_through_focus, optical_transfer
from estimator.corrections.progressive import (
    CUBES,
    ProgressiveLens,
    progressive_polynomial,
)
from estimator.corrections.rings import DiffractiveRings, Kinoform, RefractiveZones
from estimator.corrections.worn_lens import (
    WornLens,
    aberration_polynomial,
    shifted_polynomial,
    worn_polynomial,
    worn_refraction,
)
from estimator.field.prepare import prepare_eye
from estimator.optics import prescription as rx
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM
from estimator.optics.zernike import EXPONENTS, index_from_nm
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psf_batch
from estimator.wavefront.field_wavefronts import (
    correction_polynomial,
    total_defocus_dpt,
    zernike_from_polynomial,
)
from filter_service import Camera, FilterSettings
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import plan_axes
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import PsfStore
from filter_service.psfs.store_file import pack, unpack
from filter_service.view_state import State
from tests.lens_truth import (
    MM_PER_DEG,
    PUBLISHED,
    Truth,
    lens_surface_um,
    lenslet_eye,
    lenslets_truth,
    modulation,
    worn_eye,
)
from tests.worn_by_people import (
    corridor_width_mm,
    lost_by_lenslets,
    read_through_focus,
)

AT_CPD = np.arange(2.0, 40.0, 2.0)
OBJECTS_DPT = np.array([0.0, 0.6, 1.2, 2.2])
DESIGNS = {
    "bifocal": {"design": "bifocal", "add_dpt": 3.0},
    "edof": {"design": "edof", "add_dpt": 1.75},
    "rings to 3 mm": {"design": "bifocal", "add_dpt": 3.0, "rings_diameter_mm": 3.0},
    "zones": {
        "design": "zones",
        "zone_adds_dpt": [0.0, 2.5, 0.0],
        "zone_diameters_mm": [2.0, 3.0, 4.0],
    },
}


@pytest.mark.parametrize("color_ratio", [1.0, 550 / 453, 550 / 618])
@pytest.mark.parametrize("step_waves", [0.5, 1.5, 0.3])
def test_a_sawtooth_shares_light_as_sinc_squared(step_waves, color_ratio):
    orders = np.arange(-3, 5)
    found = Kinoform.sawtooth(step_waves).amplitudes(orders, color_ratio=color_ratio)
    expected = np.sinc(step_waves * color_ratio - orders) ** 2
    assert np.abs(found) ** 2 == pytest.approx(expected, abs=1e-5)


def test_the_light_of_foci_is_that_of_the_rings_a_pupil_sees():
    half, wavelength_nm = np.sinc(0.5) ** 2, 550.0
    rings = DiffractiveRings(2.2, Kinoform.sawtooth(0.5), diameter_mm=3.0)
    assert rings.main_light_ratio([1.0, 3.0], wavelength_nm) == pytest.approx(
        np.array([[half, 0.25 * half + 0.75], [half, 0.25 * half]]), abs=1e-5
    )
    zones = RefractiveZones((1.0, 2.0), (0.0, 2.5))
    assert zones.main_light_ratio([0.5, 2.0, 4.0], wavelength_nm) == pytest.approx(
        np.array([[1.0, 0.25, 1.0 / 16.0], [0.0, 0.75, 15.0 / 16.0]])
    )


def test_two_combs_are_one_where_the_other_has_no_height():
    orders = np.arange(-4, 8)
    fine = np.abs(Kinoform.two_combs(0.0, 0.5).amplitudes(orders)) ** 2
    assert fine[orders % 2 == 1] == pytest.approx(0.0, abs=1e-9)
    single = (
        np.abs(Kinoform.sawtooth(0.5).amplitudes(orders[orders % 2 == 0] // 2)) ** 2
    )
    assert fine[orders % 2 == 0] == pytest.approx(single, abs=1e-5)


@pytest.mark.parametrize(
    "light",
    [{0: 0.44, 2: 0.22, 3: 0.22}, {0: 0.41, 1: 0.41}, {0: 0.42, 1: 0.16, 2: 0.26}],
)
def test_a_profile_is_found_for_shares_of_light(light):
    found = Kinoform.with_light(light).amplitudes(np.array(list(light)))
    assert np.abs(found) ** 2 == pytest.approx(list(light.values()), abs=0.035)


@pytest.mark.parametrize("wavelength_nm", [453.0, 550.0, 618.0])
def test_no_light_is_lost_among_the_orders(wavelength_nm):
    rings = DiffractiveRings(2.2, Kinoform.sawtooth(0.5))
    assert (np.abs(rings.amplitudes(wavelength_nm)) ** 2).sum() == pytest.approx(1.0)
    added = rings.added_dpt(wavelength_nm)
    assert np.diff(added) == pytest.approx(2.2 * wavelength_nm / 550.0)


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize(
    ("pupil_mm", "limit"), [(2.0, 0.05), (3.0, 0.02), (4.5, 0.012)]
)
def test_kernels_are_those_of_the_true_profile(name, pupil_mm, limit):
    eye, wavelength_nm = worn_eye(**DESIGNS[name]), 500.0
    found = modulation(
        eye, OBJECTS_DPT, pupil_mm=pupil_mm, wavelength_nm=wavelength_nm, at_cpd=AT_CPD
    )
    truth = Truth(pupil_mm, wavelength_nm)
    behind = truth.profile(eye.rings)
    zero_dpt = eye.chromatic_shift_dpt(wavelength_nm) + eye.refraction_at_dpt(
        pupil_diameter_mm=pupil_mm
    )
    true = [
        truth.modulation(behind * truth.defocused(zero_dpt + d), AT_CPD)
        for d in OBJECTS_DPT.tolist()
    ]
    assert np.abs(found - true).max() < limit


@pytest.mark.long("the true profile of a lens is sampled")
def test_the_light_of_foci_interferes_through_small_pupils():
    """Why kernels are not sums of those of each focus."""
    rings = worn_eye(**DESIGNS["edof"]).rings
    errors = []
    for pupil_mm in (2.0, 4.5):
        truth = Truth(pupil_mm, 550.0)
        true = truth.modulation(truth.profile(rings) * truth.defocused(0.5), AT_CPD)
        errors.append(np.abs(truth.of_sum(rings, 0.5, AT_CPD) - true).max())
    assert errors[0] > 0.2
    assert errors[1] < 0.06


@pytest.mark.long("transfer of published lenses at 32 distances")
def test_published_modulation_is_met():
    table = PUBLISHED["transfer"]
    at_cpd = [table["line_pairs_per_mm"] * MM_PER_DEG]
    objects_dpt = np.arange(0.0, 3.2, 0.1)
    ranges = {"far": (0.0, 0.3), "intermediate": (0.8, 1.8), "near": (2.0, 3.2)}
    for name, lens in table["lenses"].items():
        curve = modulation(
            worn_eye(**lens["body"]),
            objects_dpt,
            pupil_mm=table["aperture_mm"],
            wavelength_nm=table["wavelength_nm"],
            at_cpd=at_cpd,
        )
        for focus in set(ranges) & set(lens):
            low, high = ranges[focus]
            inside = (objects_dpt >= low) & (objects_dpt <= high)
            found = np.abs(curve[inside, 0]).max()
            expected = pytest.approx(lens[focus], abs=table["tolerance"])
            assert found == expected, (name, focus)


def test_a_lens_off_its_center_has_coma_and_keeps_its_power():
    lens = WornLens(0.0, spherical_aberration_um=0.3, centre_mm=(0.3, -0.4))
    zernike_um = zernike_from_polynomial(aberration_polynomial(lens), 3.0)
    per_mm = -0.3 / 3.0 * 2.0 * np.sqrt(10.0)
    assert zernike_um[index_from_nm(4, 0)] == pytest.approx(0.3)
    assert zernike_um[index_from_nm(3, 1)] == pytest.approx(0.3 * per_mm)
    assert zernike_um[index_from_nm(3, -1)] == pytest.approx(-0.4 * per_mm)
    centered = aberration_polynomial(WornLens(0.0, spherical_aberration_um=0.3))
    through = zernike_from_polynomial(centered, 2.0)
    assert total_defocus_dpt(through, 2.0) == pytest.approx(0.0, abs=1e-12)


def test_a_polynomial_is_shifted(rng):
    polynomial, center = rng.normal(size=28), (0.4, -0.7)
    x, y = rng.normal(size=(2, 9))

    def value(coefficients, x, y):
        return (x[:, None] ** EXPONENTS[:, 0] * y[:, None] ** EXPONENTS[:, 1]) @ (
            coefficients
        )

    moved = shifted_polynomial(polynomial, center)
    expected = value(polynomial, x - center[0], y - center[1])
    assert value(moved, x, y) == pytest.approx(expected)


def test_refraction_of_a_lens_through_any_pupil():
    lens = WornLens(-3.0, spherical_aberration_um=-0.2, centre_mm=(0.3, 0.0))
    at_center_dpt, per_mm2 = worn_refraction(lens, entrance_pupil_mm=3.0)
    through = at_center_dpt + per_mm2 * 2.0**2
    paraxial_dpt = -3.0 / 1.009
    aside_dpt = total_defocus_dpt(
        zernike_from_polynomial(aberration_polynomial(lens), 2.0), 2.0
    )
    assert through == pytest.approx(paraxial_dpt - aside_dpt)


def test_astigmatism_beside_the_corridor_is_minkwitz_s():
    lens = ProgressiveLens.of(rx.Prescription(0.0), add_dpt=2.0, corridor_mm=14.0)
    y_mm, step_mm = np.array([-3.0, -7.0, -12.0]), 1e-4
    powers = lens.power_matrices_dpt(0.0, y_mm)
    assert powers[:, 0, 0] == pytest.approx(powers[:, 1, 1])  # an umbilical line
    above = lens.power_matrices_dpt(0.0, y_mm + step_mm)[:, 0, 0]
    slope = (above - powers[:, 0, 0]) / step_mm
    beside = np.linalg.eigvalsh(lens.power_matrices_dpt(0.01, y_mm))
    astigmatism = beside[:, 1] - beside[:, 0]
    assert astigmatism == pytest.approx(2.0 * 0.01 * np.abs(slope), rel=1e-3)


def test_the_powers_of_a_progressive_lens_are_those_of_one_surface():
    """W_xx, W_xy and W_yy of any surface have the same derivatives across."""
    lens = ProgressiveLens.of(rx.Prescription(0.0), add_dpt=2.0, corridor_mm=14.0)
    x, y, h = np.array([1.0, 6.0, -4.0]), np.array([-2.0, -9.0, -14.0]), 1e-4

    def change(dx, dy):
        more = lens.power_matrices_dpt(x + dx, y + dy)
        return (more - lens.power_matrices_dpt(x - dx, y - dy)) / (2.0 * h)

    along_x, along_y = change(h, 0.0), change(0.0, h)
    assert along_y[:, 0, 0] == pytest.approx(along_x[:, 0, 1], abs=1e-6)
    assert along_y[:, 0, 1] == pytest.approx(along_x[:, 1, 1], abs=1e-6)


def test_a_progressive_lens_takes_off_what_spectacles_of_its_power_do():
    lens = ProgressiveLens.of(
        rx.Prescription(-4.0, -1.0, 30.0, 12.0), add_dpt=2.0, corridor_mm=14.0
    ).with_gaze_offset((8.0, -20.0))
    found = progressive_polynomial(lens, 0.0, 0.0, entrance_pupil_mm=3.0)
    expected = worn_polynomial(lens, entrance_pupil_mm=3.0)
    assert found == pytest.approx(expected, abs=1e-9)
    even = correction_polynomial(lens, entrance_pupil_mm=3.0)
    assert np.flatnonzero(np.abs(found - even) > 1e-9).tolist() == CUBES


@pytest.mark.parametrize("place_mm", [(0.0, -7.0), (0.0, -10.0), (4.0, -7.0)])
def test_a_pupil_sees_the_lens_s_surface(place_mm):
    """Coma and trefoil are what powers, twice integrated over the pupil, have."""
    lens = ProgressiveLens.of(rx.Prescription(0.0), add_dpt=2.0, corridor_mm=14.0)
    u = np.stack(np.meshgrid(*[np.linspace(-2.0, 2.0, 33)] * 2), axis=-1)
    u = u[np.hypot(*np.moveaxis(u, -1, 0)) <= 2.0]
    seen_um = lens_surface_um(lens, place_mm, u)
    even = np.einsum("ni,ij,nj->n", u, lens.power_matrices_dpt(*place_mm), u) / 2.0
    h_deg, v_deg = np.degrees(np.arctan(np.array(place_mm) / TYPICAL_ENTRANCE_PUPIL_MM))
    taken = progressive_polynomial(lens, h_deg, v_deg, entrance_pupil_mm=0.0)
    held_um = -(u[:, :1] ** EXPONENTS[:, 0] * u[:, 1:] ** EXPONENTS[:, 1]) @ taken
    tilt = np.column_stack([np.ones(len(u)), u])

    def rms(um):
        return np.std(um - tilt @ np.linalg.lstsq(tilt, um, rcond=None)[0])

    assert rms(seen_um - even) > 0.02
    assert rms(seen_um - held_um) < 0.02
    assert rms(seen_um - held_um) < 0.4 * rms(seen_um - even)


def test_a_traced_eye_sees_through_each_part_of_a_progressive_lens():
    worn = {"kind": "progressive", "sphere_dpt": 0, "vertex_mm": 12, "add_dpt": 2.0}
    bare = {
        "kind": "prescription",
        "sphere_dpt": 0.0,
        "age_years": 70,
        "higher_order": "none",
    }
    fields = {
        "h_deg": np.array([0.0, 0.0, 12.0]),
        "v_deg": np.array([0.0, -20.0, -20.0]),
    }
    state = {
        "pupil_diameter_mm": 3.0,
        "accommodation_dpt": 0.0,
        "wavelength_nm": 536.0,
    }
    range_deg = ((-20.0, 20.0), (-20.0, 20.0))
    defocus = []
    for more in ({}, {"correction": worn}):
        eye, _ = prepare_eye(
            parse_profile(bare | more),
            pupil_diameters_mm=[3.0, 4.0],
            field_range_deg=range_deg,
        )
        defocus.append(eye.total_defocus_dpt(**fields, **state))
        again = eye.defocus_at(**fields, wavelength_nm=536.0)(
            pupil_diameter_mm=3.0, accommodation_dpt=0.0
        )
        assert again == pytest.approx(defocus[-1], abs=1e-6)
    lens = parse_profile(bare | {"correction": worn}).correction
    powers = lens.power_matrices_dpt(
        *lens.lens_point_mm(fields["h_deg"], fields["v_deg"])
    )
    expected = np.trace(powers, axis1=1, axis2=2) / 2.0
    assert defocus[0] - defocus[1] == pytest.approx(expected, abs=0.06)
    assert defocus[0][1] - defocus[1][1] > 0.3


@pytest.mark.long("light is carried from lens to pupil")
@pytest.mark.parametrize(
    ("v_deg", "pupil_mm"),
    [pytest.param(0.0, 4.0, marks=pytest.mark.slow), (-25.0, 3.0)],
)
def test_lenslets_are_what_carries_light_from_lens_to_pupil(v_deg, pupil_mm):
    """Straight down the clear middle is seen, lower down the honeycomb."""
    eye = lenslet_eye(gaze_deg=[0.0, v_deg])
    seen = {"pupil_mm": pupil_mm, "wavelength_nm": 555.0, "at_cpd": AT_CPD}
    found = modulation(eye, [0.0], **seen)[0]
    lens = eye.rings.seen_from(0.0, 0.0)
    assert np.abs(found - lenslets_truth(lens, **seen, depth_mm=15.05)).max() < 0.012
    perfect = np.abs(found - Truth(pupil_mm, 555.0).modulation(1.0, AT_CPD)).max()
    assert (perfect < 0.005) == (v_deg == 0.0)


def test_lenslets_are_those_of_each_direction():
    """One call for several fields is one call for each."""
    lens = lenslet_eye(gaze_deg=[0.0, 0.0]).rings
    h_deg, v_deg = np.array([0.0, 25.0, 25.0]), np.array([0.0, 0.0, -12.0])
    options = {
        "pupil_diameter_mm": 4.0,
        "wavelength_nm": 536.0,
        "pixel_pitch_mrad": 0.5,
        "radius_px": 12,
    }
    together = compute_psf_batch(
        np.zeros((3, 28)), pupil_screen=lens.seen_from(h_deg, v_deg), **options
    )
    for k in range(3):
        alone = compute_psf_batch(
            np.zeros((1, 28)),
            pupil_screen=lens.seen_from(h_deg[k], v_deg[k]),
            **options,
        )
        assert alone[0].kernel == pytest.approx(together[k].kernel, abs=1e-5)
    assert together[1].kernel.max() < 0.6 * together[0].kernel.max()
    assert together[1].kernel.max() != together[2].kernel.max()


@pytest.mark.long("acuity through two lenses at three distances")
def test_acuity_through_focus_has_the_foci_of_a_lens():
    """A monofocal lens blurs near what a bifocal one shows."""
    bifocal = worn_eye(**DESIGNS["bifocal"]).rings
    near_dpt = bifocal.spacing_dpt
    transfer = optical_transfer(
        np.zeros(28), zernike_radius_mm=1.5, wavelength_nm=550.0, pupil_screen=bifocal
    )
    truth = Truth(3.0, 550.0)
    expected = truth.modulation(truth.profile(bifocal), AT_CPD)
    assert transfer.in_phase(AT_CPD) == pytest.approx(expected, abs=0.02)
    objects_dpt = [0.0, near_dpt / 2.0, near_dpt]
    one, two = (
        acuity_through_focus(
            np.zeros(28),
            zernike_radius_mm=1.5,
            object_dpt=objects_dpt,
            wavelength_nm=550.0,
            pupil_screen=rings,
        )[0]
        for rings in (None, bifocal)
    )
    assert one[2] > one[0] + 0.4
    assert two[2] == pytest.approx(two[0], abs=0.02)
    assert one[0] < two[0] < one[0] + 0.2
    assert two[1] > two[0] + 0.1
    with pytest.raises(ValueError, match="got lenslets"):
        optical_transfer(
            np.zeros(28),
            zernike_radius_mm=1.5,
            wavelength_nm=550.0,
            pupil_screen=lenslet_eye().rings,
        )


def test_rings_are_for_the_wave_method_alone():
    rings = DiffractiveRings(2.2, Kinoform.sawtooth(0.5))
    for options in ({"method": "geometric"}, {"diffraction": False}):
        with pytest.raises(ValueError, match="pupil_screen requires"):
            compute_psf_batch(
                np.zeros((1, 28)),
                pupil_diameter_mm=3.0,
                wavelength_nm=550.0,
                pixel_pitch_mrad=1.0,
                pupil_screen=rings,
                **options,
            )


def test_the_gaze_of_the_settings_looks_through_its_part_of_a_lens():
    """Down by 30 deg a far-corrected eye of 70 years is sharp at the addition."""
    body = {"kind": "progressive", "sphere_dpt": 0.0, "vertex_mm": 12, "add_dpt": 2.0}
    profile = parse_profile(
        {"kind": "prescription", "sphere_dpt": 0.0, "age_years": 70, "correction": body}
    )
    camera = Camera.from_fov(20.0, width_px=64, height_px=48)
    far_dpt = []
    for gaze_deg in ((0.0, 0.0), (0.0, -35.0)):
        settings = FilterSettings(
            mode="on-axis", eye_model="wavefront", gaze_deg=gaze_deg
        )
        eye, notes = eye_for_spec(profile, GridSpec(camera, settings))
        far_dpt.append(eye.sharpest_dpt(0.0, pupil_diameter_mm=4.0))
        assert not notes
    assert far_dpt[0] == pytest.approx(0.05, abs=0.02)
    assert far_dpt[1] == pytest.approx(2.0, abs=0.08)


def test_colors_may_have_different_numbers_of_foci():
    """Layers are counted from the first focus of green."""
    body = {
        "kind": "iol",
        "design": "trifocal",
        "adds_dpt": [1.66, 3.33],
        "steps_waves": [0.35, 0.45],
    }
    profile = parse_profile(
        {"kind": "prescription", "sphere_dpt": -1.0, "correction": body}
    )
    eye = MeasuredWavefront.from_profile(profile)
    spec = GridSpec(
        Camera.from_fov(20.0, width_px=64, height_px=48),
        FilterSettings(mode="on-axis", eye_model="wavefront"),
    )
    foci_dpt = [eye.rings.main_dpt(nm) for nm in spec.channel_wavelengths_nm.tolist()]
    assert len({found.size for found in foci_dpt}) > 1
    store = PsfStore(eye, spec, plan_axes(eye, spec))
    layers = frame_layers(store, State(3.0, 0.0))
    green_dpt = foci_dpt[1][0] - layers.layer_zero_dpt[0, 1]
    steps_dpt = layers.layer_dpt - green_dpt
    assert steps_dpt[0] < 0.0 < steps_dpt[-1]
    assert np.abs(steps_dpt).min() < 1e-9


def test_an_eye_with_rings_is_stored_and_read():
    eye = worn_eye(**DESIGNS["bifocal"])
    again = unpack(*pack(eye))
    assert again.rings == eye.rings
    assert np.array_equal(again.zernike_um, eye.zernike_um)


def test_a_traced_eye_with_an_intraocular_lens_is_not_said_to_be_out_of_reach():
    """Its fit leaves 0.0002 dpt of what the lens corrects."""
    body = {"kind": "iol", "design": "bifocal", "add_dpt": 3.0}
    profile = parse_profile(
        {"kind": "prescription", "sphere_dpt": 0.0, "correction": body}
    )
    eye, _ = prepare_eye(
        profile, pupil_diameters_mm=[4.0], field_range_deg=((-5.0, 5.0), (-5.0, 5.0))
    )
    far_dpt, _ = eye.focus_limits_dpt(4.0)
    assert 1e-5 < abs(far_dpt) < 1e-3
    assert eye.notes(pupil_diameter_mm=4.0, focus_dpt=0.0) == ()


@pytest.mark.long("acuity through a lens at several distances")
def test_people_read_so_much_through_an_extended_depth_of_focus():
    table = PUBLISHED["people"]["edof"]
    limit = table["tolerance_log_mar"]
    ahead, *behind = read_through_focus([0.0, *map(float, table["log_mar_by_dpt"])])
    assert ahead == pytest.approx(table["best_log_mar"], abs=limit)
    expected = list(table["log_mar_by_dpt"].values())
    assert behind == pytest.approx(expected, abs=limit)


def test_people_lose_so_much_behind_lenslets():
    table = PUBLISHED["people"]["lenslets"]
    log_mar, log_contrast = lost_by_lenslets()
    for lost, name in (
        (log_mar, "lost_log_mar"),
        (log_contrast, "lost_log_contrast"),
    ):
        for published in table[name].values():
            assert lost == pytest.approx(published, abs=table["tolerance"])


def test_a_corridor_is_about_as_wide_as_it_is_said_to_be():
    table = PUBLISHED["people"]["progressive"]
    expected_mm = pytest.approx(table["width_mm"], abs=table["tolerance_mm"])
    assert corridor_width_mm() == expected_mm
