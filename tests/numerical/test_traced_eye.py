"""The ray-traced eye behind the PSF cache, against direct traces and measurements."""

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.field.traced_eye import TracedEye
from estimator.optics.prescription import C20
from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.optics.zernike import remove_central_tilt, rescale_pupil
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.psf.compute import compute_psfs
from estimator.wavefront.aberrations import wavefront_aberrations, wavefront_grid
from estimator.wavefront.field_wavefronts import (
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial
from filter_service.camera import Camera
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.frame_kernels import frame_kernels, interval_count
from filter_service.rendering.image_cells import image_cells
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.reference import render_passes as reference

PUPILS_MM = (3.0, 4.0, 5.0, 6.0)
GREEN_NM = RGB_WAVELENGTHS_NM[1]
AXIS = {"h_deg": 0.0, "v_deg": 0.0}
NORMAL = {"kind": "prescription", "sphere_dpt": 0.0}


def traced(body, *, wavelengths_nm=RGB_WAVELENGTHS_NM, pupils_mm=PUPILS_MM):
    estimated = estimate_eye(parse_profile(body))
    return estimated, TracedEye.trace(
        estimated,
        pupil_diameters_mm=pupils_mm,
        focus_range_dpt=(0.0, 6.0),
        wavelengths_nm=wavelengths_nm,
    )


def measured_in_pupil_um(profile, depth_mm):
    """The measurement (28,) carried to a plane behind the cornea."""
    radius_mm = profile.pupil_diameter_mm / 2.0
    at_cornea_um = remove_central_tilt(profile.zernike_um)
    moved_um = moved_polynomial(
        polynomial_in_mm(at_cornea_um, radius_mm),
        depth_mm=depth_mm,
        radius_mm=radius_mm,
    )
    return zernike_from_polynomial(moved_um, radius_mm)


@pytest.mark.parametrize("name", preset_names())
def test_relaxed_eye_has_the_measured_wavefront(name):
    profile = parse_profile({"kind": "preset", "name": name})
    pupil_mm, wavelength_nm = profile.pupil_diameter_mm, profile.wavelength_nm
    estimated, eye = traced(
        {"kind": "preset", "name": name},
        wavelengths_nm=(wavelength_nm,),
        pupils_mm=(pupil_mm,),
    )
    relaxed = {"pupil_diameter_mm": pupil_mm, "accommodation_dpt": 0.0}
    if eye.grid.accommodations_dpt[0] > 0.0:  # a little hyperopic at 555 nm
        relaxed["accommodation_dpt"] = float(eye.grid.accommodations_dpt[0])
    total_dpt = eye.total_defocus_dpt(**relaxed, wavelength_nm=wavelength_nm)
    zernike_um = eye.wavefronts(
        **AXIS, **relaxed, wavelength_nm=wavelength_nm, total_defocus_dpt=total_dpt
    ).zernike_um[0]
    depth_mm = estimated.accommodating.entrance_pupil_mm
    error_um = zernike_um - measured_in_pupil_um(profile, depth_mm)
    accommodates = relaxed["accommodation_dpt"] > 0.0
    assert np.sqrt(np.sum(error_um**2)) <= (0.02 if accommodates else 1e-9)


def test_larger_pupils_are_traced_and_not_extrapolated():
    body = {"kind": "preset", "name": "cataract"}  # measured at 4 mm
    estimated, eye = traced(body)
    direct = wavefront_grid(
        estimated.surfaces(0.0, pupil_diameter_mm=6.0),
        fields_deg=[[0.0, 0.0]],
        wavelengths_nm=[GREEN_NM],
        pupil_diameters_mm=[6.0],
        plane="pupil",
    )
    found = eye.wavefronts(
        **AXIS,
        pupil_diameter_mm=6.0,
        accommodation_dpt=0.0,
        wavelength_nm=GREEN_NM,
        total_defocus_dpt=1.0,
    )
    assert found.circle_diameter_mm == pytest.approx([6.0], abs=1e-12)
    ours = found.zernike_um[0]
    polynomial_um = polynomial_in_mm(direct.zernike_um, direct.zernike_radius_mm)
    rest = estimated.rest(GREEN_NM)
    rest_um = rest.residues_um(np.array([3.0]), np.ones(1))
    expected_um = zernike_from_polynomial(polynomial_um[0, 0, 0] + rest_um[0], 3.0)
    higher = np.arange(28) > 5
    assert np.abs(ours - expected_um)[higher].max() < 1e-9
    assert eye.usable_pupil_mm(6.0) == 6.0
    assert not eye.notes(pupil_diameter_mm=6.0, focus_dpt=5.0)


@pytest.mark.parametrize("pupil_mm", [3.0, 4.5, 6.0])
@pytest.mark.parametrize("focus_dpt", [0.5, 2.0, 4.7])
@pytest.mark.parametrize("sphere_dpt", [0.0, 4.0])
def test_an_object_at_the_focus_is_in_focus(sphere_dpt, focus_dpt, pupil_mm):
    body = {"kind": "prescription", "sphere_dpt": sphere_dpt, "higher_order": "none"}
    _, eye = traced(body, wavelengths_nm=(555.0,), pupils_mm=(3.0, 4.5, 6.0))
    total_dpt = focus_dpt + eye.total_defocus_dpt(
        pupil_diameter_mm=pupil_mm,
        accommodation_dpt=eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm),
        wavelength_nm=555.0,
    )
    assert total_dpt == pytest.approx(0.0, abs=0.01)


def test_a_focus_that_was_not_traced_is_said():
    estimated = estimate_eye(parse_profile(NORMAL))
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=PUPILS_MM,
        focus_range_dpt=(0.0, 2.0),
        wavelengths_nm=(555.0,),
    )
    for pupil_mm in PUPILS_MM:
        assert eye.notes(pupil_diameter_mm=pupil_mm, focus_dpt=1.9) == ()
        (note,) = eye.notes(pupil_diameter_mm=pupil_mm, focus_dpt=4.0)
        assert "outside the prepared range" in note
        used_dpt = eye.reachable_focus_dpt(4.0, pupil_diameter_mm=pupil_mm)
        assert 1.98 < used_dpt < 3.0


@pytest.mark.parametrize("focus_range_dpt", [(0.0, 2.0), (1.0, 2.0), (2.0, 6.0)])
def test_accommodations_are_no_denser_than_blending_needs(focus_range_dpt):
    """Nodes are at most 1 dpt apart, and one node fewer would be more than that."""
    _, eye = traced(NORMAL, wavelengths_nm=(555.0,), pupils_mm=(3.0, 5.0))
    nodes_dpt = eye.accommodation_nodes_dpt(focus_range_dpt, pupil_range_mm=(3.0, 5.0))
    range_dpt = nodes_dpt[-1] - nodes_dpt[0]
    assert range_dpt > 0.9 * (focus_range_dpt[1] - focus_range_dpt[0])
    assert np.diff(nodes_dpt).max() <= 1.0 + 1e-9
    assert nodes_dpt.size == 2 or range_dpt > nodes_dpt.size - 2


def test_worn_correction_moves_the_far_point():
    body = {"kind": "prescription", "sphere_dpt": -4.0, "higher_order": "none"}
    _, bare = traced(body)
    _, worn = traced({**body, "correction": {"sphere_dpt": -4.0}})
    assert bare.refraction_dpt == pytest.approx(-4.0, abs=0.01)
    assert worn.refraction_dpt == pytest.approx(0.0, abs=0.01)
    state = {
        "pupil_diameter_mm": 5.0,
        "accommodation_dpt": 0.0,
        "wavelength_nm": GREEN_NM,
    }
    assert worn.total_defocus_dpt(**state) - bare.total_defocus_dpt(
        **state
    ) == pytest.approx(4.0 / (1.0 + 4.0 * 0.0029), abs=0.01)


def test_accommodation_makes_spherical_aberration_more_negative():
    """As in every measured eye (Cheng et al. 2004: about -0.05 um per dpt at 5 mm)."""
    _, eye = traced({"kind": "preset", "name": "emmetropia"})
    by_use = eye.grid.zernike_um[0, 0, PUPILS_MM.index(5.0), :, 1, 12]
    assert np.all(np.diff(by_use) < 0.0)


def test_blended_kernels_equal_traced_ones_between_nodes():
    body = {"kind": "preset", "name": "emmetropia"}
    estimated, _ = traced(body)
    spec = grid_spec(
        camera=Camera(1000, 1000, (-0.65, 0.65, 0.65, -0.65)),
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(2, 5),
    )

    eye, notes = eye_for_spec(parse_profile(body), spec)
    assert "estimated" in notes[0]
    store = build_psf_store(eye, spec)
    pupil_mm, focus_dpt, object_dpt = 4.5, 3.37, 4.2
    layers = frame_layers(store, State(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt))
    k = int(np.argmin(np.abs(layers.layer_dpt - object_dpt)))
    used = np.zeros((1, interval_count(layers)), bool)
    used[0, k] = True
    image = image_cells(spec, store.plan)
    kernels = frame_kernels(store, layers, image, used)
    blended = reference.kernel_pairs(store, kernels)[0, 0, ..., 1]
    direct = wavefront_aberrations(
        estimated.surfaces(focus_dpt, pupil_diameter_mm=pupil_mm),
        wavelength_nm=GREEN_NM,
        pupil_diameter_mm=pupil_mm,
    )
    zernike_um = rescale_pupil(
        direct.zernike_um, radius_ratio=pupil_mm / 2 / direct.zernike_radius_mm
    )
    zernike_um[C20] -= layers.layer_dpt[k] * (pupil_mm / 2) ** 2 / (4 * np.sqrt(3))
    truth = compute_psfs(
        zernike_um[None],
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=GREEN_NM,
        pixel_pitch_mrad=1.3,
        radius_px=blended.shape[1] // 2,
    )[0].kernel
    error = np.linalg.norm(blended - truth) / np.linalg.norm(truth)
    assert error < 0.1


def test_wavefront_and_traced_eye_agree_where_both_hold():
    """At the measured pupil, relaxed: the same PSF to a few per cent."""
    profile = parse_profile({"kind": "preset", "name": "keratoconus"})
    measured = MeasuredWavefront.from_profile(profile)
    _, eye = traced({"kind": "preset", "name": "keratoconus"}, pupils_mm=(5.0,))
    state = {
        "pupil_diameter_mm": 5.0,
        "accommodation_dpt": 0.0,
        "wavelength_nm": GREEN_NM,
    }
    kernels = [
        compute_psfs(
            one.wavefronts(**AXIS, **state, total_defocus_dpt=-1.5).zernike_um,
            pupil_diameter_mm=5.0,
            wavelength_nm=GREEN_NM,
            pixel_pitch_mrad=1.3,
            radius_px=20,
        )[0].kernel
        for one in (measured, eye)
    ]
    difference = np.linalg.norm(kernels[0] - kernels[1])
    assert difference < 0.05 * np.linalg.norm(kernels[0])
