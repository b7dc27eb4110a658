"""The eye of the published pipeline, against its networks and against ray tracing."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.field.network_eye import NetworkEye, network_eye, trained_range
from estimator.networks.inference import NetworkUnavailable, network_aberrations
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.profiles.files import load_profile
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import polynomial_in_mm, rim_from_ellipse
from estimator.wavefront.moved_plane import moved_polynomial, moved_rim
from filter_service.filtering.stream_eyes import AcceptedProfile
from filter_service.planning.cost import predicted_cost
from filter_service.planning.plan import plan_cache
from filter_service.psfs.compute_kernels import psf_engine
from filter_service.psfs.store import PsfStore
from filter_service.settings import FilterSettings
from tests.grid_specs import grid_spec

FIELD_DEG = ((-45.0, 45.0), (-24.0, 24.0))
STATE = {"pupil_diameter_mm": 4.0, "wavelength_nm": REFERENCE_WAVELENGTH_NM}


def eye_of(profile, field_range_deg=FIELD_DEG, focus_range_dpt=(0.125, 4.125)):
    return network_eye(
        profile,
        pupil_range_mm=(2.0, 6.0),
        focus_range_dpt=focus_range_dpt,
        wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
        field_range_deg=field_range_deg,
    )


@pytest.fixture(scope="module")
def keratoconus():
    """The estimated eye, the same by network over the field, and its notes."""
    profile = load_profile("keratoconus")
    return estimate_eye(profile, method="network"), *eye_of(profile)


def test_wavefronts_over_the_field_are_those_of_the_aberration_network(keratoconus):
    found, eye, _ = keratoconus
    h_deg, v_deg = np.array([0.0, 8.0, -33.0]), np.array([0.0, -12.0, 20.0])
    expected = network_aberrations(
        found.parameters.to_vector(), h_deg=h_deg, v_deg=v_deg, **STATE
    )
    # Their own plane is the cornea.
    polynomial_um = polynomial_in_mm(expected.zernike_um, expected.zernike_radius_mm)
    depth_mm = np.full(3, eye.entrance_pupil_mm)
    polynomial_um = moved_polynomial(
        polynomial_um, depth_mm=depth_mm, radius_mm=expected.zernike_radius_mm
    )
    seen = eye.wavefronts(
        h_deg=h_deg, v_deg=v_deg, accommodation_dpt=0.0, total_defocus_dpt=0.0, **STATE
    )
    own_um = polynomial_in_mm(seen.zernike_um, seen.circle_diameter_mm / 2.0)
    # Defocus is replaced; astigmatism and the third order are left.
    for monomials in ([4], [6, 7, 8, 9]):
        np.testing.assert_allclose(
            own_um[:, monomials],
            polynomial_um[:, monomials],
            atol=0.02 * np.abs(polynomial_um[:, monomials]).max(),
        )


def test_errors_that_the_notes_tell_are_those_against_tracing(keratoconus):
    found, eye, notes = keratoconus
    values = {note.code: note.values for note in notes}
    assert values["eye_by_network"]["mean_error_um"] == found.mean_abs_error_um
    grid = eye.grid
    h, v = np.array([0, 0, -1, -1]), np.array([0, -1, 0, -1])
    (relaxed,) = found.accommodating.states_at([0.0])
    traced = wavefront_grid(
        relaxed.surfaces,
        fields_deg=np.column_stack([grid.h_deg[h], grid.v_deg[v]]),
        wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
        pupil_diameters_mm=[6.0],
        plane="pupil",
    )
    off_um = grid.zernike_um[h, v, -1, 0, 0, 1:] - traced.zernike_um[:, 0, 0, 1:]
    told = values["aberrations_by_network"]
    assert told["pupil_diameter_mm"] == 6.0
    # The accommodated state, which the note includes, has about the same error.
    assert told["corner_error_um"] == pytest.approx(np.abs(off_um).mean(), rel=0.3)
    assert told["on_axis_error_um"] < told["corner_error_um"]


def test_the_rest_of_the_measurement_is_not_added(keratoconus):
    found, eye, notes = keratoconus
    assert eye._residual.rms_um == 0.0
    assert found.rest([REFERENCE_WAVELENGTH_NM]).rms_um > 0.0
    (told,) = [note for note in notes if note.code == "published_not_modeled"]
    assert "the residual of the measurement" in told
    assert "the periphery of measured eyes" in told


def test_pupils_are_limited_to_those_of_the_grid_with_a_note(keratoconus):
    _, eye, _ = keratoconus
    assert isinstance(eye, NetworkEye)
    for asked_mm, used_mm, code in (
        (1.0, 2.0, "pupil_raised"),
        (7.5, 6.0, "pupil_capped"),
    ):
        assert eye.usable_pupil_mm(asked_mm) == used_mm
        note = eye.notes(pupil_diameter_mm=asked_mm, focus_dpt=3.0)[0]
        assert note.code == code
        assert note.values == {"pupil_diameter_mm": asked_mm, "used_mm": used_mm}
    assert not eye.notes(pupil_diameter_mm=4.0, focus_dpt=3.0)


def test_focus_by_network_is_sharp_to_its_error(keratoconus):
    """Zero total defocus at the focus, to the errors of both networks."""
    _, eye, _ = keratoconus
    used_dpt = eye.accommodation_dpt(3.0, pupil_diameter_mm=4.0)
    total_dpt = eye.total_defocus_dpt(accommodation_dpt=used_dpt, **STATE)
    assert float(total_dpt) == pytest.approx(-3.0, abs=0.1)


def test_fields_beyond_the_training_range_have_the_wavefront_at_its_edge():
    wide = ((-60.0, 60.0), (0.0, 0.0))
    eye, _ = eye_of(load_profile("myopia"), wide, (0.0, 0.0))
    edge_deg = trained_range("aberration", "h_deg")[1]
    at_dpt = eye.total_defocus_dpt(
        h_deg=[edge_deg, 60.0], accommodation_dpt=0.0, **STATE
    )
    assert at_dpt[0] == at_dpt[1]


def test_its_psfs_are_those_of_the_series_few_at_a_time():
    spec = grid_spec(
        **{"width_px": 32, "height_px": 18, "tangents": (-0.02, 0.02, 0.01, -0.01)},
        **{"pipeline": "published", "pupil_range_mm": (3.0, 3.0)},
        focus_range_dpt=(0.125, 0.125),
    )
    eye = MeasuredWavefront.from_profile(load_profile("emmetropia"))
    plan, breaks = plan_cache(eye, spec), []
    store = PsfStore(eye, spec, plan)
    psfs = np.arange(2 * psf_engine("published").batch_count + 1)
    store.fill(psfs, batch_count=256, between=lambda: breaks.append(store.methods))
    assert store.methods == {"enz_unchecked": psfs.size}
    assert len(breaks) == 2
    exact = predicted_cost(eye, spec.with_settings(pipeline="exact"), plan)
    own = predicted_cost(eye, spec, plan)
    assert own["psf_count"] == exact["psf_count"]
    assert own["build_s"] > 20.0 * exact["build_s"]


@pytest.mark.parametrize(
    ("pipeline", "has_haze"), [("published", False), ("exact", True)]
)
def test_media_are_left_out(pipeline, has_haze):
    settings = FilterSettings(pipeline=pipeline)
    accepted = AcceptedProfile(1, 1, load_profile("cataract"), settings)
    assert (accepted.media_effects is not None) == has_haze


ON_AXIS = ((0.0, 0.0), (0.0, 0.0))
NOT_MODELED = {
    "a correction": {
        "kind": "prescription",
        "sphere_dpt": -3,
        "correction": {"sphere_dpt": -3, "vertex_mm": 12},
    },
    "kind 'published' defines the eye by its surfaces": {
        "kind": "published",
        "name": "arizona",
    },
    "a retina other": {
        "kind": "prescription",
        "sphere_dpt": -3,
        "retina": {"radius_mm": 12.0},
    },
    "zernike_j4_um": {"kind": "prescription", "sphere_dpt": -20},
}


@pytest.mark.parametrize("problem", NOT_MODELED)
def test_what_the_networks_do_not_model_is_refused(problem):
    with pytest.raises(NetworkUnavailable, match=problem):
        eye_of(parse_profile(NOT_MODELED[problem]), ON_AXIS, (0.0, 0.0))


def test_an_eye_given_by_its_parameters_is_not_estimated(keratoconus):
    found, *_ = keratoconus
    profile = replace(found.profile, eye=found.parameters, measurements=())
    eye, notes = eye_of(profile, ON_AXIS, (0.0, 0.0))
    codes = {note.code for note in notes}
    assert "eye_given_by_parameters" in codes
    assert not codes & {"eye_by_network", "published_not_modeled"}
    assert eye.max_pupil_diameter_mm == 6.0


def test_rims_move_as_rays_do():
    """A defocused eye: every ray has the slope 2 a r, so that a rim is scaled."""
    ellipse_mm = np.array([0.3, -0.2, 2.0, 1.5, 0.7])
    polynomial_um = np.zeros(28)
    polynomial_um[[3, 5]] = 4.0  # um/mm²: x² and y²
    rim_mm = moved_rim(rim_from_ellipse(ellipse_mm), polynomial_um, depth_mm=3.0)
    scale = 1.0 + 2.0 * 4.0e-3 * 3.0
    np.testing.assert_allclose(rim_mm, scale * rim_from_ellipse(ellipse_mm), rtol=1e-12)
