"""Eyes given by surfaces: the same eye in two formats, laws, focus and frames."""

import json
from dataclasses import replace

import numpy as np
import pytest

from estimator.estimate.model import eye_model
from estimator.eye.assembly import accommodated, eye_surfaces
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters
from estimator.eye.surface_eye import StatesDiffer, SurfaceModel
from estimator.eye.tracing import TraceFailed
from estimator.field.prepare import prepare_eye
from estimator.optics.forms import SeparateProfiles, TwoConics
from estimator.profiles.files import load_profile
from estimator.profiles.parse import parse_profile
from estimator.profiles.surfaces import published_eye
from estimator.wavefront.aberrations import wavefront_aberrations
from filter_service.building.from_profile import build
from filter_service.building.jobs import BuildJob, BuildLimits
from filter_service.camera import Camera
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.view_sources import EyeState
from tests.numerical.surface_bodies import RELAXED
from tests.numerical.synthetic import psnr_db, texture


def body_of(eye):
    """The lists of a profile for the surfaces of an eye."""

    def shape(part):
        return {
            "radius_mm": list(np.broadcast_to(part.radius_mm, 2)),
            "conic_constant": part.conic_constant,
            "z_mm": part.z_mm,
            "rotation_deg": part.rotation_deg,
            "decentration_mm": list(part.decentration_mm),
            "tilt_deg": list(part.tilt_deg),
        }

    return {
        "surfaces": [
            {
                **shape(s),
                "medium_after": s.medium_after,
                "offset_mm": None if s.offset_mm is None else s.offset_mm.tolist(),
                "offset_radius_mm": s.offset_radius_mm,
            }
            for s in eye.surfaces
        ],
        "stop_z_mm": eye.stop_z_mm,
        "retina": shape(eye.retina),
    }


def irregular_parameters():
    """A myope with coma, a turned cornea and a displaced, tilted lens."""
    values = dict(EyeParameters.mean_eye().to_mapping())
    values["eye_length_mm"] += 0.8
    values |= {
        "cornea_anterior_rotation_deg": 20.0,
        "cornea_posterior_astigmatism_ratio": 0.97,
        "lens_decentration_x_mm": 0.15,
        "lens_tilt_about_y_deg": 3.0,
        "cornea_offset_j5_mm": -6e-4,
        "cornea_offset_j7_mm": 4e-4,
    }
    return EyeParameters.from_vector([values[name] for name in PARAMETER_NAMES])


def test_the_45_parameters_as_surfaces_have_the_same_wavefronts():
    """Over field, pupil, accommodation and color, with the lens in eight states."""
    parameters = irregular_parameters()
    by_parameters = parse_profile(
        {"kind": "eye", "parameters": parameters.to_mapping()}
    )
    relaxed_mm = parameters.lens_diameter_mm
    states = [
        {
            "accommodation_dpt": float(k),
            **body_of(
                eye_surfaces(
                    accommodated(
                        parameters, lens_diameter_mm=relaxed_mm * (1 - 0.0155 * k)
                    )
                )
            ),
        }
        for k in range(1, 9)
    ]
    for state in states:
        del state["retina"]
    by_surfaces = parse_profile(
        {"kind": "surfaces", **body_of(eye_surfaces(parameters)), "states": states}
    )
    assert by_surfaces.digest != by_parameters.digest
    field = {"field_range_deg": ((-20.0, 20.0), (-10.0, 10.0))}
    first, second = (
        prepare_eye(profile, focus_range_dpt=(0.0, 4.0), **field)[0]
        for profile in (by_parameters, by_surfaces)
    )
    far = [eye.focus_limits_dpt(4.0)[0] for eye in (first, second)]
    assert far[1] == pytest.approx(far[0], abs=1e-4)
    worst_um = []
    for focus_dpt in (far[0], 3.5):
        found = []
        for eye in (first, second):
            accommodation_dpt = eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=4.0)
            waves = eye.wavefronts(
                h_deg=[0.0, 15.0, -20.0],
                v_deg=[0.0, 8.0, -10.0],
                pupil_diameter_mm=4.0,
                accommodation_dpt=accommodation_dpt,
                wavelength_nm=536.0,
                total_defocus_dpt=0.0,
            )
            found.append(waves.zernike_um)
        worst_um.append(np.abs(found[1] - found[0])[:, 3:].max())
    assert worst_um[0] < 1e-6  # relaxed: the same numbers, traced by the same rays
    assert worst_um[1] < 1e-3  # between the states, where the lens is blended


def test_states_follow_a_quadratic_law_exactly():
    """The law of the Arizona eye (Schwiegerling), between its stored states."""
    model = published_eye("arizona").model
    for a in (0.0, 1.3, 5.0, 7.7):
        eye = model.at(a)
        anterior, posterior = eye.surfaces[2], eye.surfaces[3]
        assert anterior.radius_mm[0] == pytest.approx(12.0 - 0.4 * a)
        assert anterior.conic_constant == pytest.approx(-7.518749 + 1.28572 * a)
        assert posterior.radius_mm[1] == pytest.approx(-5.224557 + 0.2 * a)
        assert posterior.conic_constant == pytest.approx(-1.353971 - 0.431762 * a)
        assert anterior.z_mm == eye.stop_z_mm == pytest.approx(3.52 - 0.04 * a)
        assert posterior.z_mm - anterior.z_mm == pytest.approx(3.767 + 0.04 * a)
        index = eye.media["lens"].d_line_index
        assert index == pytest.approx(1.42 + 0.00256 * a - 0.00022 * a * a)


@pytest.mark.parametrize("name", ["arizona", "le_grand_relaxed"])
@pytest.mark.parametrize("focus_dpt", [1.0, 4.2])
def test_a_focused_eye_has_no_defocus_for_its_distance(name, focus_dpt):
    """By tracing the state itself, at the distance; 45-parameter eyes meet 0.01 D."""
    eye = eye_model(load_profile(name)).accommodating
    state = eye.focused(focus_dpt, pupil_diameter_mm=3.0)
    assert state.focus_dpt == pytest.approx(focus_dpt, abs=1e-3)
    assert not state.notes
    found = wavefront_aberrations(
        state.surfaces, wavelength_nm=555.0, pupil_diameter_mm=3.0, object_dpt=focus_dpt
    )
    defocus_dpt = 4.0 * 3.0**0.5 * found.zernike_um[4] / found.zernike_radius_mm**2
    assert abs(defocus_dpt) < 0.01


def test_an_eye_in_one_state_does_not_accommodate():
    eye = eye_model(parse_profile(RELAXED)).accommodating
    assert eye.amplitude_dpt == 0.0
    far_dpt, near_dpt = eye.focus_limits_dpt(4.0)
    assert far_dpt == near_dpt
    (note,) = eye.focused(far_dpt + 2.0).notes
    assert "nearer than the near point" in note


def test_age_limits_the_states():
    young, old = (
        eye_model(parse_profile({"kind": "published", "name": "arizona", **more}))
        for more in ({}, {"age_years": 50})
    )
    assert old.amplitude_dpt < 3.0 < young.amplitude_dpt


def test_spectacles_correct_a_surface_eye():
    bare = eye_model(parse_profile(RELAXED))
    worn = {"correction": {"sphere_dpt": bare.refraction_dpt}}
    through = eye_model(parse_profile({**RELAXED, **worn}))
    assert abs(bare.refraction_dpt) > 0.2
    assert abs(through.refraction_dpt) < 1e-6


@pytest.mark.parametrize(
    ("surface", "change", "reason"),
    [
        (2, {"clear_radius_mm": 0.3}, r"surfaces\[2\]: outside a clear radius"),
        (2, {"radius_mm": 1.2}, r"surfaces\[2\]: missed a surface"),
        (
            3,
            {"radius_mm": -2.2, "medium_after": "air"},
            r"surfaces\[3\]: total reflection",
        ),
    ],
)
def test_light_that_does_not_pass_is_an_error_in_words(surface, change, reason):
    surfaces = [dict(s) for s in RELAXED["surfaces"]]
    surfaces[surface] |= change
    indices = {"lens": 1.8} if surface == 3 else None
    profile = parse_profile({**RELAXED, "surfaces": surfaces, "indices": indices})
    with pytest.raises(TraceFailed, match="light does not .*" + reason):
        prepare_eye(profile)


def test_the_digest_tells_forms_of_equal_numbers_apart():
    relaxed = published_eye("bennett_rabbetts").surfaces
    digests = set()
    for form in (None, TwoConics((0.0, 0.0)), SeparateProfiles((0.0, 0.0))):
        first = replace(relaxed.surfaces[0], form=form)
        eye = replace(relaxed, surfaces=(first, *relaxed.surfaces[1:]))
        digests.add(SurfaceModel(eye).digest)
        digests.add(SurfaceModel(eye, (2.0,), (eye,)).digest)
    assert len(digests) == 6


def test_a_plane_is_blended_by_its_curvature():
    relaxed = published_eye("bennett_rabbetts").surfaces
    flat, curved = (
        replace(
            relaxed,
            surfaces=(
                *relaxed.surfaces[:2],
                replace(relaxed.surfaces[2], radius_mm=(radius_mm,) * 2),
                *relaxed.surfaces[3:],
            ),
        )
        for radius_mm in (np.inf, 10.0)
    )
    model = SurfaceModel(flat, (4.0,), (curved,))
    assert model.at(0.0).surfaces[2].radius_mm == (np.inf, np.inf)
    assert model.at(2.0).surfaces[2].radius_mm == pytest.approx((20.0, 20.0))
    bounded = replace(curved.surfaces[0], clear_radius_mm=5.0)
    other = replace(curved, surfaces=(bounded, *curved.surfaces[1:]))
    with pytest.raises(StatesDiffer, match=r"surfaces\[0\].clear_radius_mm"):
        SurfaceModel(flat, (4.0,), (other,)).at(2.0)


WIDTH, HEIGHT = 48, 36
CAMERA = Camera(WIDTH, HEIGHT, (-0.048, 0.048, 0.036, -0.036))
SETTINGS = FilterSettings(
    mode="dynamic",
    pupil_range_mm=(3.8, 4.2),
    focus_range_dpt=(0.2, 3.0),
    object_range_dpt=(0.0, 3.0),
)


@pytest.mark.parametrize(
    "name",
    [
        "arizona",
        pytest.param("atchison_2006", marks=pytest.mark.slow),
        pytest.param("toric", marks=pytest.mark.slow),
        pytest.param("implant", marks=pytest.mark.slow),
    ],
)
@pytest.mark.long("the exact PSF of every pixel is computed")
def test_frames_agree_with_the_exact_psf_of_every_pixel(engine, name, rng):
    """A lens that accommodates, a gradient, a toric cornea, and a tilted implant."""
    if name == "toric":
        first = {**RELAXED["surfaces"][0], "radius_mm": [7.9, 7.6], "rotation_deg": 25}
        body = {**RELAXED, "surfaces": [first, *RELAXED["surfaces"][1:]]}
    elif name == "implant":
        body = {
            "kind": "pseudophakic",
            "axial_length_mm": 23.4,
            "keratometry_dpt": [42.5, 43.5],
            "keratometry_axis_deg": 170,
            "lens_center_mm": 4.9,
            "implant": {"power_dpt": 21.5, "tilt_deg": [2, 4], "abbe_number": 50},
        }
    else:
        body = {"kind": "published", "name": name}
    job = BuildJob(
        profile=parse_profile(json.loads(json.dumps(body))),
        settings=SETTINGS,
        camera=CAMERA,
        limits=BuildLimits(),
    )
    store = build(job, progress=lambda *_: None, cancelled=lambda: False).store
    color = texture(rng, HEIGHT, WIDTH, cell_px=4).astype(np.float32)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[10:26, 14:34] = 1.0 / 3.0
    view = RgbdView(color, depth_m, CAMERA.tangents)
    renderer = engine.new_renderer()
    found = renderer.render(
        view,
        renderer.load(store),
        pupil_diameter_mm=4.0,
        focus_dpt=1.5,
        render_tolerance=0.0,
    )
    state = EyeState(store.eye, store.spec, 4.0, 1.5)
    exact = dense_reference(view, state, bins=False, kept=False)
    inner = (slice(8, -8), slice(8, -8))
    assert psnr_db(found.color[inner], exact[inner]) > 40.0
