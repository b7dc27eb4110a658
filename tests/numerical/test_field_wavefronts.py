"""Wavefronts over the visual field against direct traces, symmetry and formulas."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.eye.tracing import pupil_refraction_dpt
from estimator.field.field_table import field_table
from estimator.field.interpolation import (
    FieldInterpolation,
    aberration_grid,
    field_nodes_deg,
)
from estimator.field.prepare import few_colors_grid
from estimator.field.traced_eye import TracedEye
from estimator.optics.prescription import power_vector, zernike_from_power_vector
from estimator.optics.zernike import flip_horizontal, zernike_values
from estimator.profiles.files import load_profile
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.psf.compute import compute_psf_batch
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import (
    N_RIM,
    c20_by_degree,
    circumscribed_radius_mm,
    ellipse_from_rim,
    polynomial_in_mm,
    rim_from_ellipse,
    total_defocus_dpt,
    zernike_from_polynomial,
)

WIDE_DEG = ((-45.0, 45.0), (-25.0, 25.0))
BLUE_NM = 464.0
WORST_WAVES, WORST_RATIO = 0.02, 0.01
WORST_RIM_RATIO = 0.012
"""Keratoconus at 2 mm, in the corners of the field; 0.005 for a healthy eye."""


def estimated(**body):
    """Eyes whose periphery is the model's, as it is traced."""
    return estimate_eye(parse_profile({**body, "periphery": "model"}))


def traced(eye, *, pupils_mm=(2.0, 4.0, 7.0), foci_dpt=(0.0, 4.0), fields=WIDE_DEG):
    return TracedEye.trace(
        eye,
        pupil_diameters_mm=pupils_mm,
        focus_range_dpt=foci_dpt,
        wavelengths_nm=(BLUE_NM,),
        field_range_deg=fields,
    )


def unscaled(eye, **state):
    """Coefficients and rims as traced, without the scaling to the pupil on axis."""
    total_dpt = eye.total_defocus_dpt(**state)
    found = eye.wavefronts(**state, total_defocus_dpt=total_dpt)
    polynomial = polynomial_in_mm(found.zernike_um, found.circle_diameter_mm / 2.0)
    shape = total_dpt.shape
    rim_mm = rim_from_ellipse(found.pupil_ellipse)
    return polynomial.reshape(*shape, 28), rim_mm.reshape(*shape, 5)


def points_of(rim_mm):
    """Points (..., 192, 2) that fill a rim evenly."""
    angle = 2.0 * np.pi * np.arange(24) / 24
    radius = np.sqrt((np.arange(8) + 0.5) / 8)[:, None]
    x, y = (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()
    cx, cy, xx, xy, yy = np.moveaxis(rim_mm[..., None], -2, 0)
    return np.stack([cx + xx * x + xy * y, cy + xy * x + yy * y], axis=-1)


def rms_um(zernike_um, radius_mm, rim_mm):
    """Of a wavefront over its pupil, without piston."""
    unit = points_of(rim_mm) / radius_mm[..., None, None]
    values = zernike_values(unit[..., 0], unit[..., 1])
    return (values * zernike_um[..., None, :]).sum(axis=-1).std(axis=-1)


def rest_um(source, fields_deg, pupils_mm):
    """What is added to traced wavefronts (fields, pupils, 28)."""
    rest = source.rest(BLUE_NM)
    share = rest.left_share(*fields_deg.T)[:, None]
    radius_mm = np.broadcast_to(pupils_mm / 2.0, (len(share), len(pupils_mm)))
    residues_um = rest.residues_um(radius_mm, np.broadcast_to(share, radius_mm.shape))
    return residues_um + rest.color_um(np.array(BLUE_NM))


OFTEN = ("cataract", "keratoconus", "myopia")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in OFTEN))
        for name in preset_names()
    ],
)
def test_interpolated_wavefronts_equal_direct_traces(name):
    rng = np.random.default_rng(len(name))
    source = estimated(kind="preset", name=name)
    eye = traced(source)
    corners = [(-45.0, 25.0), (45.0, -25.0), (45.0, 0.0), (0.0, 0.0)]
    fields_deg = np.concatenate(
        [corners, rng.uniform(-1.0, 1.0, (3, 2)) * [WIDE_DEG[0][1], WIDE_DEG[1][1]]]
    )
    pupils_mm = np.array([2.0, 3.1, 4.7, 6.0, 7.0])
    low_dpt, high_dpt = eye.grid.accommodations_dpt[[0, -1]]
    for used_dpt in np.unique([low_dpt, low_dpt + 0.37 * (high_dpt - low_dpt)]):
        state = source.accommodating.states_at([used_dpt])[0]
        direct = wavefront_grid(
            state.surfaces,
            fields_deg=fields_deg,
            wavelengths_nm=[BLUE_NM],
            pupil_diameters_mm=pupils_mm,
            plane="pupil",
        )
        radius_mm = direct.zernike_radius_mm[:, 0]
        rim_mm = rim_from_ellipse(direct.ellipse_mm[:, 0])
        seen_um, our_rim_mm = unscaled(
            eye,
            h_deg=fields_deg[:, :1],
            v_deg=fields_deg[:, 1:],
            pupil_diameter_mm=pupils_mm,
            accommodation_dpt=used_dpt,
            wavelength_nm=BLUE_NM,
        )
        polynomial_um = seen_um - rest_um(source, fields_deg, pupils_mm)
        truth_um = direct.zernike_um[:, 0]
        difference_um = zernike_from_polynomial(polynomial_um, radius_mm) - truth_um
        error_um = rms_um(difference_um, radius_mm, rim_mm)
        allowed_um = np.maximum(
            WORST_WAVES * BLUE_NM / 1000.0,
            WORST_RATIO * rms_um(truth_um, radius_mm, rim_mm),
        )
        assert np.max(error_um / allowed_um) < 1.0
        on_axis = 3  # where the traced rim is scaled to the pupil asked for
        scale = pupils_mm / 2.0 / circumscribed_radius_mm(rim_mm[on_axis])
        rim_error_mm = np.abs(our_rim_mm - rim_mm * scale[:, None]).max(axis=(0, 2))
        assert np.all(rim_error_mm < WORST_RIM_RATIO * pupils_mm / 2.0)


def test_a_field_range_leaves_the_axis_as_it_is():
    source = estimated(kind="preset", name="keratoconus")
    states = {
        **{"h_deg": 0.0, "v_deg": 0.0, "pupil_diameter_mm": np.array([2.0, 4.0, 7.0])},
        **{"accommodation_dpt": np.array([[0.0], [1.0]]), "wavelength_nm": BLUE_NM},
        "total_defocus_dpt": -1.0,
    }
    axis = traced(source, fields=((0.0, 0.0), (0.0, 0.0))).wavefronts(**states)
    found = traced(source).wavefronts(**states)
    assert axis.circle_diameter_mm == pytest.approx([2, 4, 7, 2, 4, 7], abs=1e-12)
    assert found.circle_diameter_mm == pytest.approx([2, 4, 7, 2, 4, 7], abs=1e-9)
    assert found.zernike_um == pytest.approx(axis.zernike_um, abs=0.02)


def test_the_pupil_of_exact_directions_is_the_same_without_the_axis():
    """The pupil on the axis was interpolated between them: 0.1 % too narrow."""
    h_deg, v_deg = (a.ravel() for a in np.meshgrid([-40.0, 15.0], [-18.0, 5.0]))
    view = {"pupil_diameter_mm": 4.0, "wavelength_nm": 555.0}
    profile = load_profile("arizona")
    together = field_table(profile, h_deg=h_deg, v_deg=v_deg, **view)
    for k in (0, 3):
        alone = field_table(profile, h_deg=h_deg[k], v_deg=v_deg[k], **view)
        found, expected = together.pupil_ellipse[k], alone.pupil_ellipse[0]
        assert found == pytest.approx(expected, abs=1e-9)
        assert together.zernike_um[k] == pytest.approx(alone.zernike_um[0], abs=1e-9)


def test_a_symmetric_eye_is_mirror_symmetric():
    eye = traced(estimated(kind="prescription", sphere_dpt=-3.0, higher_order="none"))
    rest = {
        **{"v_deg": np.array([-18.0, 0.0, 7.0]), "pupil_diameter_mm": 5.0},
        **{"accommodation_dpt": 0.5, "wavelength_nm": BLUE_NM},
    }
    rest["total_defocus_dpt"] = -2.0
    right, left = (eye.wavefronts(h_deg=h, **rest) for h in (31.0, -31.0))
    assert np.abs(right.zernike_um[:, 8]).min() > 0.1  # horizontal coma
    assert flip_horizontal(right.zernike_um) == pytest.approx(left.zernike_um, abs=1e-4)
    mirror = np.array([-1.0, 1.0, 1.0, -1.0, 1.0])
    assert rim_from_ellipse(right.pupil_ellipse) * mirror == pytest.approx(
        rim_from_ellipse(left.pupil_ellipse), abs=1e-5
    )


def test_a_far_field_sees_a_narrow_pupil():
    """Aspect ratio of a real eye's pupil at 40 deg: 0.78 (Mathur et al. 2013)."""
    eye = traced(estimated(kind="preset", name="emmetropia"))
    found = eye.wavefronts(
        h_deg=40.0,
        v_deg=0.0,
        pupil_diameter_mm=4.0,
        accommodation_dpt=0.0,
        wavelength_nm=BLUE_NM,
        total_defocus_dpt=0.0,
    )
    _, _, major_mm, minor_mm, axis_rad = found.pupil_ellipse[0]
    assert minor_mm / major_mm == pytest.approx(0.79, abs=0.02)
    assert axis_rad == pytest.approx(np.pi / 2, abs=1e-3)


def test_a_worn_correction_is_taken_off_alike_at_all_fields():
    worn = {"sphere_dpt": -4.0, "cylinder_dpt": -1.0, "axis_deg": 30.0}
    body = {"kind": "prescription", **worn, "higher_order": "none"}
    bare_eye = traced(estimated(**body), foci_dpt=(-4.0, 0.0))
    worn_profile = parse_profile({**body, "correction": worn, "periphery": "model"})
    worn_eye = traced(estimate_eye(worn_profile), foci_dpt=(-4.0, 0.0))
    state = {
        **{"h_deg": np.array([0.0, 33.0, -12.0]), "v_deg": np.array([0.0, -20.0, 9.0])},
        **{
            "pupil_diameter_mm": 4.4,
            "accommodation_dpt": 0.0,
            "wavelength_nm": BLUE_NM,
        },
    }
    difference = unscaled(bare_eye, **state)[0] - unscaled(worn_eye, **state)[0]
    expected_um = zernike_from_power_vector(
        *power_vector(worn_profile.correction, depth_mm=2.89), zernike_radius_mm=2.2
    )
    for polynomial_um in difference:
        on_circle_um = zernike_from_polynomial(polynomial_um, 2.2)
        assert on_circle_um == pytest.approx(expected_um, abs=2e-3)


@pytest.fixture(scope="module")
def cataract():
    return traced(estimated(kind="preset", name="cataract"), pupils_mm=(2.0, 5.0))


def test_many_states_at_once_equal_one_by_one(cataract):
    eye = cataract
    h_deg, pupils_mm = np.array([[-40.0], [3.0], [-40.0]]), np.array([2.5, 5.0])
    rest = {"v_deg": 5.0, "accommodation_dpt": 1.1, "wavelength_nm": BLUE_NM}
    rest["total_defocus_dpt"] = np.array([[1.0], [1.0], [3.0]])
    found = eye.wavefronts(h_deg=h_deg, pupil_diameter_mm=pupils_mm, **rest)
    assert found.zernike_um.shape == (6, 28)
    for p, (i, j) in enumerate(np.ndindex(3, 2)):
        one = {**rest, "total_defocus_dpt": rest["total_defocus_dpt"][i, 0]}
        alone = eye.wavefronts(h_deg=h_deg[i, 0], pupil_diameter_mm=pupils_mm[j], **one)
        assert found.zernike_um[p] == pytest.approx(alone.zernike_um[0], abs=1e-10)
        assert found.pupil_ellipse[p] == pytest.approx(alone.pupil_ellipse[0])
    total_dpt = -4.0 * np.sqrt(3.0) * found.zernike_um[:, 4]
    total_dpt /= (found.circle_diameter_mm / 2.0) ** 2
    assert total_dpt == pytest.approx([1, 1, 1, 1, 3, 3])


def test_psf_engines_take_the_wavefronts():
    eye = traced(estimated(kind="preset", name="keratoconus"))
    found = eye.wavefronts(
        h_deg=np.array([0.0, 40.0, -45.0]),
        v_deg=np.array([0.0, 0.0, 25.0]),
        pupil_diameter_mm=4.0,
        accommodation_dpt=0.0,
        wavelength_nm=BLUE_NM,
        total_defocus_dpt=0.3,
    )
    batch = compute_psf_batch(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        wavelength_nm=BLUE_NM,
        pixel_pitch_mrad=1.3,
    )
    assert [float(psf.kernel.sum()) for psf in batch] == pytest.approx([1, 1, 1])
    assert batch.radius_px[2] > batch.radius_px[0]


def test_measured_wavefront_is_the_same_at_every_field():
    eye = MeasuredWavefront.from_profile(
        parse_profile({"kind": "preset", "name": "keratoconus"})
    )
    state = {"pupil_diameter_mm": 3.0, "accommodation_dpt": 1.0, "wavelength_nm": 464.0}
    total_dpt = eye.total_defocus_dpt(**state) + 2.5
    found = eye.wavefronts(
        h_deg=np.array([0.0, 40.0]), v_deg=7.0, **state, total_defocus_dpt=total_dpt
    )
    expected = eye.state(
        pupil_diameter_mm=3.0,
        object_dpt=2.5,
        focus_dpt=1.0 - eye.refraction_at_dpt(pupil_diameter_mm=3.0),
        wavelength_nm=464.0,
    )
    for p in range(2):
        assert found.zernike_um[p] == pytest.approx(expected.zernike_um, abs=1e-12)
        assert found.pupil_ellipse[p, :4] == pytest.approx([0.0, 0.0, 1.5, 1.5])
    many_dpt = eye.total_defocus_dpt(
        h_deg=np.zeros((2, 1)), **{**state, "wavelength_nm": np.array([464.0, 612.0])}
    )
    assert many_dpt.shape == (2, 2)
    with pytest.raises(ValueError, match="pupil_diameter_mm"):
        eye.total_defocus_dpt(**{**state, "pupil_diameter_mm": 5.5})


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"h_deg": 12.0}, "h_deg"),
        ({"v_deg": -6.0}, "v_deg"),
        ({"pupil_diameter_mm": 7.5}, "pupil_diameter_mm"),
        ({"accommodation_dpt": 4.5}, "accommodation_dpt"),
        ({"wavelength_nm": 500.0}, "wavelength_nm"),
        ({"accommodation_dpt": float("nan")}, "accommodation_dpt"),
    ],
)
def test_states_that_were_not_traced_are_refused(change, word):
    eye = traced(
        estimated(kind="preset", name="emmetropia"), fields=((-10, 10), (-5, 5))
    )
    state = {"h_deg": 0.0, "v_deg": 0.0, "pupil_diameter_mm": 3.0}
    state |= {"accommodation_dpt": 0.0, "wavelength_nm": BLUE_NM}
    with pytest.raises(ValueError, match=word):
        eye.total_defocus_dpt(**(state | change))


def test_a_field_range_must_ascend():
    with pytest.raises(ValueError, match="field_range_deg"):
        traced(estimated(kind="preset", name="emmetropia"), fields=((5, -5), (0, 0)))


def test_fields_that_light_does_not_pass_take_the_nearest_that_it_does():
    eye = traced(
        estimated(kind="preset", name="keratoconus"),
        pupils_mm=(3.0, 5.0),
        foci_dpt=(0.0, 0.0),
        fields=((-75.0, 75.0), (-55.0, 55.0)),
    )
    (_, h_high), (_, v_high) = eye.traced_range_deg
    assert 30.0 < h_high < 75.0
    rest = {
        "pupil_diameter_mm": 5.0,
        "accommodation_dpt": 0.0,
        "wavelength_nm": BLUE_NM,
    }
    rest["total_defocus_dpt"] = 0.0
    grid = np.meshgrid(np.linspace(-75, 75, 13), np.linspace(-55, 55, 9))
    everywhere = eye.wavefronts(h_deg=grid[0], v_deg=grid[1], **rest)
    assert np.isfinite(everywhere.zernike_um).all()
    assert np.all(everywhere.pupil_ellipse[:, 3] > 0.5)
    beyond = eye.wavefronts(h_deg=75.0, v_deg=0.0, **rest)
    edge = eye.wavefronts(h_deg=h_high, v_deg=0.0, **rest)
    assert beyond.zernike_um == pytest.approx(edge.zernike_um)
    assert v_high < 55.0


@pytest.mark.parametrize(
    ("name", "h_deg", "allowed_um", "allowed_dpt"),
    [
        pytest.param("emmetropia", 32.0, 8e-4, 5e-3, marks=pytest.mark.slow),
        pytest.param("keratoconus", 32.0, 1.5e-3, 5e-3, marks=pytest.mark.slow),
        # -12 dpt at the corners
        pytest.param("cataract", 32.0, 3e-3, 2e-2, marks=pytest.mark.slow),
        ("cataract", 57.0, 1e-7, 1e-7),  # light does not pass everywhere
    ],
)
@pytest.mark.long("an eye is traced over the field in both ways")
def test_colors_beside_the_traced_one_are_as_good(name, h_deg, allowed_um, allowed_dpt):
    source = estimated(kind="preset", name=name)
    ranges = ((-h_deg, h_deg), (-20.0, 20.0))
    axes = {
        "pupil_diameters_mm": np.linspace(2.0, 7.0, 4),
        "focus_range_dpt": (0.0, 4.0),
        "wavelengths_nm": np.array([453.0, 536.0, 618.0]),
        "field_range_deg": ranges,
    }
    eyes = [
        TracedEye.trace(source, field_grid=grid, **axes)
        for grid in (aberration_grid, few_colors_grid)
    ]
    rng = np.random.default_rng(5)
    n_states = 300
    state = {
        "h_deg": rng.uniform(*ranges[0], n_states),
        "v_deg": rng.uniform(*ranges[1], n_states),
        "pupil_diameter_mm": rng.uniform(2.5, 6.0, n_states),
        "accommodation_dpt": rng.uniform(0.0, 1.0, n_states)
        * eyes[0].grid.accommodations_dpt[-1],
        "wavelength_nm": rng.choice(axes["wavelengths_nm"], n_states),
    }
    exact, found = (eye.wavefronts(**state, total_defocus_dpt=0.0) for eye in eyes)
    rms_um = np.sqrt(((exact.zernike_um - found.zernike_um)[:, 3:] ** 2).sum(axis=1))
    is_middle = state["wavelength_nm"] == 536.0
    assert rms_um[is_middle].max() < 1e-7
    assert np.sqrt((rms_um**2).mean()) < allowed_um
    dpt = [eye.total_defocus_dpt(**state) for eye in eyes]
    assert np.abs(dpt[0] - dpt[1]).max() < allowed_dpt
    shift_mrad = [
        eye.chief_ray_shift_mrad(
            **{k: v for k, v in state.items() if k != "pupil_diameter_mm"}
        )
        for eye in eyes
    ]
    np.testing.assert_allclose(*shift_mrad, atol=2e-3)


def test_a_vignetted_field_is_seen_through_the_open_area():
    """The cut-off pupil's own fit, here nonsense, must not reach its neighbors."""
    source = estimated(kind="preset", name="emmetropia")
    axes = {"pupil_diameters_mm": (4.0, 7.0), "accommodations_dpt": (0.0,)}
    axes |= {"wavelengths_nm": (BLUE_NM,)}
    nodes_deg = field_nodes_deg(-20.0, 20.0)
    whole = aberration_grid(source, h_deg=nodes_deg, **axes)
    zernike_um, open_ratio = whole.zernike_um.copy(), whole.open_ratio.copy()
    zernike_um[-1, 0, 1] += 50.0
    open_ratio[-1, 0, 1] = 0.5
    cut = replace(whole, zernike_um=zernike_um, open_ratio=open_ratio)
    axis = FieldInterpolation(aberration_grid(source, **axes))
    ranges = {"field_range_deg": ((-20, 20), (0, 0))}
    ranges["traced_range_deg"] = ranges["field_range_deg"]
    eyes = [
        TracedEye(source, axis, FieldInterpolation(g), **ranges) for g in (whole, cut)
    ]
    state = {"v_deg": 0.0, "accommodation_dpt": 0.0, "wavelength_nm": BLUE_NM}
    state |= {"h_deg": nodes_deg[[0, -1]], "total_defocus_dpt": 0.0}
    before, after = (eye.wavefronts(pupil_diameter_mm=7.0, **state) for eye in eyes)
    for eye in eyes:  # prepared fields know of it too
        state_deg = {name: state[name] for name in ("h_deg", "v_deg", "wavelength_nm")}
        states = {"pupil_diameter_mm": 7.0, "accommodation_dpt": 0.0}
        np.testing.assert_allclose(
            eye.defocus_at(**state_deg)(**states),
            eye.total_defocus_dpt(**state_deg, **states),
            rtol=1e-12,
        )
    shrunk = after.circle_diameter_mm / before.circle_diameter_mm
    assert shrunk == pytest.approx([1.0, np.sqrt(0.5)], rel=0.01)
    in_mm = [
        polynomial_in_mm(w.zernike_um, w.circle_diameter_mm / 2)
        for w in (before, after)
    ]
    ours, theirs = (zernike_from_polynomial(p[1], 2.4) for p in in_mm)
    assert ours[5:] == pytest.approx(theirs[5:], abs=0.1)


def test_rims_and_their_circles():
    rng = np.random.default_rng(3)
    ellipse = np.stack(
        [
            *rng.uniform(-0.4, 0.4, (2, 50)),
            rng.uniform(2.0, 3.0, 50),
            rng.uniform(1.0, 2.0, 50),
            rng.uniform(0.0, np.pi, 50),
        ],
        axis=-1,
    )
    rim_mm = rim_from_ellipse(ellipse)
    assert ellipse_from_rim(rim_mm) == pytest.approx(ellipse, abs=1e-12)
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    cx, cy, xx, xy, yy = rim_mm.T[:, :, None]
    x = cx + xx * np.cos(angle) + xy * np.sin(angle)
    y = cy + xy * np.cos(angle) + yy * np.sin(angle)
    highest_mm = np.hypot(x, y).max(axis=1)
    assert circumscribed_radius_mm(rim_mm) == pytest.approx(highest_mm, rel=1e-7)


@pytest.mark.parametrize("n_terms", [28, 36, 66])
def test_refraction_over_a_round_pupil_is_that_of_its_coefficients(rng, n_terms):
    """Zernike terms are orthogonal, so higher orders have no part in M."""
    zernike_um, radius_mm = rng.normal(size=(3, n_terms)), np.array([1.0, 2.2, 3.4])
    polynomial_um = polynomial_in_mm(zernike_um, radius_mm)
    rim_mm = np.zeros((3, N_RIM))
    rim_mm[:, 2] = rim_mm[:, 4] = radius_mm
    expected_dpt = total_defocus_dpt(zernike_um, radius_mm)
    assert pupil_refraction_dpt(polynomial_um, rim_mm) == pytest.approx(expected_dpt)
    by_degree_um = c20_by_degree(polynomial_um)
    degree = 2 + 2 * np.arange(by_degree_um.shape[-1])
    sums_um = (by_degree_um * radius_mm[:, None] ** degree).sum(axis=-1)
    assert sums_um == pytest.approx(zernike_um[:, 4])
