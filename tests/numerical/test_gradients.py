"""Gradient-index media against SciPy's DOP853 and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.forms import EvenAsphere, TwoConics
from estimator.optics.gradients import (
    GoncharovDaintyGradient,
    PolynomialGradient,
    SquaredPolynomialGradient,
)
from estimator.optics.media import Constant
from estimator.optics.paraxial import cardinal_points, entrance_pupil_mm
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.optics.surfaces import EyeSurfaces, Retina, Surface, media_indices
from estimator.optics.zernike import zernike_values
from estimator.wavefront.aberrations import pupil_magnification, wavefront_grid
from estimator.wavefront.nodes import stop_nodes
from tests.numerical.schematic_eyes import field_axes, liou_brennan
from tests.reference.traced_rays import trace

WAVELENGTH_NM = 540.0
PLANE = (math.inf, math.inf)
LENS = {"decentration_mm": (0.2, -0.1), "tilt_deg": (3.0, -2.0)}


def _tilted_eye(steps=4):
    """No symmetry: a tilted gradient lens that ends on an asphere, a tilted retina."""
    eye = liou_brennan(steps=steps)
    *front, anterior, equator, posterior = eye.surfaces
    posterior = replace(
        posterior,
        form=EvenAsphere((0.002, -2e-4, 1e-5, -3e-7)),
        conic_constant=-0.5,
        radius_mm=(-8.1, -7.6),
        rotation_deg=30.0,
    )
    lens = tuple(replace(s, **LENS) for s in (anterior, equator, posterior))
    retina = Retina(
        (11.5, 12.3),
        0.0,
        23.95,
        tilt_deg=(4.0, -3.0),
        decentration_mm=(0.3, 0.1),
        form=TwoConics((0.1, 0.25)),
    )
    return replace(eye, surfaces=(*front, *lens), retina=retina)


def _goncharov_eye(steps=4):
    """The form of Goncharov & Dainty with all terms, stronger than in a real lens."""
    eye = liou_brennan()
    anterior = (1.37, -0.002, -3e-6, 0.048, -0.016, 3e-4, -2e-4)
    posterior = (1.408, -0.0021, 4e-6, 0.001, -0.007, -2e-4, 1e-4)
    lens = {
        "anterior lens": GoncharovDaintyGradient(anterior, steps=steps),
        "posterior lens": GoncharovDaintyGradient(posterior, steps=steps),
    }
    return replace(eye, media={**eye.media, **lens})


EYES = {
    "Liou-Brennan": liou_brennan,
    "tilted": _tilted_eye,
    "Goncharov-Dainty": _goncharov_eye,
}


def _rays(rng, count=8, degrees=40.0):
    angle, turn = rng.uniform(0.0, degrees, count), rng.uniform(0.0, 6.28, count)
    sine = np.sin(np.radians(angle))
    direction = np.stack(
        [sine * np.cos(turn), sine * np.sin(turn), np.cos(np.radians(angle))], -1
    )
    aim = np.concatenate(
        [rng.uniform(-1.8, 1.8, (count, 2)), np.full((count, 1), 3)], 1
    )
    return aim - 8.0 * direction, direction


@pytest.mark.parametrize("name", EYES)
def test_rays_match_an_independent_integration(name, rng):
    eye, (start, direction) = EYES[name](), _rays(rng)
    traced = trace_rays(
        eye, start_mm=start, direction=direction, wavelength_nm=WAVELENGTH_NM
    )
    assert np.all(traced.status_index == RayStatus.TRACED)
    elements = [e for e in range(7) if e != traced.stop_index]
    for k in range(len(start)):
        points, paths, _ = trace(eye, start[k], direction[k], WAVELENGTH_NM)
        assert np.abs(traced.points_mm[k, elements] - points).max() < 1e-8
        assert np.abs(traced.path_mm[k, elements] - paths).max() < 1e-8  # 1e-5 um


@pytest.mark.parametrize("name", EYES)
def test_light_returns_through_a_gradient(name, rng):
    eye, (start, direction) = EYES[name](), _rays(rng, 40)
    inward = trace_rays(
        eye, start_mm=start, direction=direction, wavelength_nm=WAVELENGTH_NM
    )
    outward = trace_rays(
        eye,
        start_mm=inward.points_mm[:, -1],
        direction=-inward.direction_ratio[:, -1],
        wavelength_nm=WAVELENGTH_NM,
        reverse=True,
    )
    assert np.all(outward.status_index == RayStatus.TRACED)
    assert np.abs(outward.points_mm - inward.points_mm).max() < 1e-8
    assert np.abs(outward.direction_ratio[:, 0] + direction).max() < 1e-9
    length = inward.path_mm[:, -1] - inward.path_mm[:, 0]
    assert np.abs(outward.path_mm[:, 0] - length).max() < 1e-8


ROD_INDEX, ROD_STRENGTH, ROD_MM = 1.6, 0.15, 6.0


def _rod(steps):
    """A parabolic rod, n² = n0² (1 - g² r²), between air and air."""
    squared, bend = ROD_INDEX**2, -((ROD_INDEX * ROD_STRENGTH) ** 2)
    return EyeSurfaces(
        (
            Surface(PLANE, 0.0, 0.0, "air"),
            Surface(PLANE, 0.0, 1.0, "rod"),
            Surface(PLANE, 0.0, 1.0 + ROD_MM, "air"),
        ),
        0.5,
        Retina(1e9, 0.0, 10.0),
        media={"rod": SquaredPolynomialGradient(((squared,), (bend,)), steps=steps)},
    )


def _rod_ray(steps):
    """Height, slope n dx/ds and optical path at the far end, and their errors."""
    sine, height = 0.3, 1.0
    cosine = math.sqrt(1.0 - sine**2)
    traced = trace_rays(
        _rod(steps),
        start_mm=(height - sine / cosine, 0.0, 0.0),
        direction=(sine, 0.0, cosine),
        wavelength_nm=555.0,
    )
    assert traced.status_index[0] == RayStatus.TRACED
    along = math.sqrt(ROD_INDEX**2 * (1.0 - (ROD_STRENGTH * height) ** 2) - sine**2)
    turn = ROD_STRENGTH * ROD_INDEX / along
    swing, phase = sine / along / turn, turn * ROD_MM
    x = height * math.cos(phase) + swing * math.sin(phase)
    # integral over z of x², of which the path takes n0² (L - g² that) / n_z
    double = math.sin(2.0 * phase) / (4.0 * turn)
    squares = (
        height**2 * (ROD_MM / 2.0 + double)
        + swing**2 * (ROD_MM / 2.0 - double)
        + height * swing * math.sin(phase) ** 2 / turn
    )
    path = ROD_INDEX**2 * (ROD_MM - ROD_STRENGTH**2 * squares) / along
    return (
        abs(traced.points_mm[0, 3, 0] - x),
        abs(traced.path_mm[0, 3] - traced.path_mm[0, 2] - path),
    )


def test_a_parabolic_rod_obeys_its_closed_form():
    assert max(_rod_ray(24)) < 1e-12


def test_halving_the_step_shows_the_sixth_order():
    errors = np.array([_rod_ray(steps) for steps in (4, 8, 16)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all(orders > 5.8), orders


def test_luneburgs_lens_focuses_parallel_light_on_its_back():
    """n² = 2 - r² / R²: every ray meets the far vertex with one optical path."""
    radius = 3.0
    squared = ((1.0, 2.0 / radius, -1.0 / radius**2), (-1.0 / radius**2,))
    ball = EyeSurfaces(
        (
            Surface(PLANE, 0.0, -2.0, "air"),
            Surface((radius, radius), 0.0, 0.0, "ball"),
            Surface((-radius, -radius), 0.0, 2.0 * radius, "air"),
        ),
        -1.0,
        Retina(12.0, 0.0, 10.0),
        media={"ball": SquaredPolynomialGradient(squared, steps=32)},
    )
    heights = np.linspace(-2.4, 2.4, 9)
    start = np.stack([heights, 0.3 * heights, np.full(9, -3.0)], -1)
    traced = trace_rays(
        ball, start_mm=start, direction=(0.0, 0.0, 1.0), wavelength_nm=555.0
    )
    assert np.all(traced.status_index == RayStatus.TRACED)
    assert np.abs(traced.points_mm[:, 3] - [0.0, 0.0, 2.0 * radius]).max() < 1e-9
    # from the plane through the front vertex: R (1 + pi / 2)
    length = traced.path_mm[:, 3] - 3.0
    assert np.abs(length - radius * (1.0 + math.pi / 2.0)).max() < 1e-9


def _directions(eye, origin, chief, targets):
    """Directions from the retinal point to points of the stop, by our own rays.

    An error here moves a sample of the wavefront without changing its value.
    """
    frame = np.linalg.svd(chief[None])[2][1:]
    ab = np.zeros((len(targets), 2))

    def stop_points(ab):
        direction = ab @ frame + np.sqrt(1.0 - (ab**2).sum(1))[:, None] * chief
        traced = trace_rays(
            eye,
            start_mm=origin,
            direction=direction,
            wavelength_nm=WAVELENGTH_NM,
            reverse=True,
        )
        return direction, traced.points_mm[:, traced.stop_index, :2]

    h = 1e-6
    for _ in range(8):
        direction, at = stop_points(ab)
        columns = [(stop_points(ab + h * e)[1] - at) / h for e in np.eye(2)]
        jacobian = np.stack(columns, -1)
        ab = ab + np.linalg.solve(jacobian, (targets - at)[..., None])[..., 0]
    return direction


@pytest.mark.long("rays are integrated in small steps by another program")
@pytest.mark.parametrize(
    "h_deg",
    [
        pytest.param(0.0, marks=pytest.mark.slow),
        pytest.param(13.0, marks=pytest.mark.slow),
        pytest.param(27.0, marks=pytest.mark.slow),
        40.0,
    ],
)
def test_wavefronts_match_an_independent_integration(h_deg):
    eye, stop_mm = liou_brennan(), 4.0
    found = wavefront_grid(
        eye,
        fields_deg=[[h_deg, 0.0]],
        wavelengths_nm=[WAVELENGTH_NM],
        stop_diameters_mm=[stop_mm],
        n_rings=5,
        n_azimuths=14,
    )
    one = (0, 0, 0)
    assert found.open_ratio[one] == pytest.approx(1.0)
    origin, plane = found.retinal_point_mm[one], found.pupil_point_mm[one]
    rings, weights, azimuths = stop_nodes(5, 14)
    targets = (azimuths[:, None] * rings[:, None]).reshape(-1, 2) * stop_mm / 2.0
    targets = np.concatenate([[[0.0, 0.0]], targets])
    chief = np.array([0.0, 0.0, eye.stop_z_mm]) - origin
    directions = _directions(eye, origin, chief / np.linalg.norm(chief), targets)
    ex, ey, u = field_axes(h_deg, 0.0)
    samples = []
    for direction in directions:
        points, paths, last = trace(eye, origin, direction, WAVELENGTH_NM, reverse=True)
        distance = -((points[-1] - plane) @ u) / (last @ u)
        at = points[-1] + distance * last - plane
        samples.append((at @ ex, at @ ey, paths[-1] + distance))
    x, y, path = np.array(samples).T
    assert math.hypot(x[0], y[0]) < 1e-6  # the chief ray defines the plane
    radius, root = found.zernike_radius_mm[one], np.sqrt(np.tile(weights, 14))
    basis = zernike_values(x[1:] / radius, y[1:] / radius)
    wave_um = 1e3 * (path[0] - path[1:])
    terms = np.linalg.lstsq(basis * root[:, None], wave_um * root, rcond=None)[0]
    assert np.abs(terms[1:] - found.zernike_um[one][1:]).max() < 1e-4


def test_first_order_optics_agree_with_rays_near_the_axis():
    eye, height_mm = liou_brennan(), 1e-3
    points = cardinal_points(eye, wavelength_nm=WAVELENGTH_NM)
    traced = trace_rays(
        eye,
        start_mm=(height_mm, 0.0, -5.0),
        direction=(0.0, 0.0, 1.0),
        wavelength_nm=WAVELENGTH_NM,
    )
    point, direction = traced.points_mm[0, -2], traced.direction_ratio[0, -2]
    slope = direction[0] / direction[2]
    index = media_indices(eye, WAVELENGTH_NM)[5]
    assert point[2] - point[0] / slope == pytest.approx(points.image_focus_mm, abs=1e-5)
    power_dpt = -1e3 * index * slope / height_mm
    assert power_dpt == pytest.approx(points.power_dpt, abs=1e-5)
    assert pupil_magnification(eye) == pytest.approx(
        cardinal_points(eye, wavelength_nm=555.0).entrance_pupil_ratio, abs=1e-6
    )
    assert entrance_pupil_mm(eye, wavelength_nm=555.0) == pytest.approx(3.098, abs=1e-3)


def test_the_gradient_shifts_with_wavelength_as_published():
    """n(λ) = n(555) + 0.0512 - 0.1455 λ + 0.0961 λ², the same for every medium."""
    eye = liou_brennan()
    rows = media_indices(eye, [450.0, 555.0, 650.0])
    assert rows.shape == (3, 6 + 2 * (2 + 2 + 6))
    shift = rows[:, 1] - rows[1, 1]
    for i in (2, 3, 4, 5):
        assert np.abs(rows[:, i] - rows[1, i] - shift).max() < 1e-14


def _changed(**media):
    eye = liou_brennan()
    return replace(eye, media={**eye.media, **media})


@pytest.mark.parametrize(
    ("eye", "message"),
    [
        (replace(liou_brennan(), stop_z_mm=4.0), r"surfaces\[2\].*the stop at 4 mm"),
        (
            _changed(**{"anterior lens": PolynomialGradient(((1.4, -2.0),))}),
            r"surfaces\[2\].*squared index",
        ),
        (
            _changed(vitreous=PolynomialGradient(((1.336,),))),
            r"surfaces\[4\].*must be homogeneous",
        ),
        (_changed(cornea=Constant(-1.3)), r"surfaces\[0\].*index -1.3"),
    ],
)
def test_a_malformed_gradient_eye_is_refused(eye, message):
    with pytest.raises(ValueError, match=message):
        trace_rays(
            eye, start_mm=(0, 0, -2), direction=(0, 0, 1), wavelength_nm=WAVELENGTH_NM
        )
