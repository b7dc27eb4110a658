"""Traced rays against OpticStudio, optiland, closed forms and themselves reversed."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.media import refractive_index
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.optics.surfaces import EyeSurfaces, Retina, Surface, rotation_matrix
from tests.numerical.optiland_eye import (
    FROZEN,
    WAVELENGTH_NM,
    random_eye,
    random_rays,
    trace_with_optiland,
)
from tests.numerical.schematic_eyes import (
    case_eye,
    irregular_eye,
    opticstudio_eye,
    reference,
)
from tests.numerical.surface_bodies import parsed_eye

REFERENCE = reference()


def test_media_match_the_independent_table():
    table = REFERENCE["indices"]["herzberger"]
    for wavelength_nm, media in table.items():
        for medium, expected in media.items():
            found = refractive_index(medium, float(wavelength_nm))
            assert abs(found - expected) < 1e-12, (medium, wavelength_nm)


def test_media_match_the_indices_of_the_published_eye():
    for wavelength_nm, media in REFERENCE["indices"]["ESN1999_table"].items():
        for medium, expected in media.items():
            assert abs(refractive_index(medium, float(wavelength_nm)) - expected) < 2e-4


@pytest.mark.parametrize("wavelength_nm", [364.9, 1014.1, math.nan])
def test_a_wavelength_outside_the_formula_is_refused(wavelength_nm):
    with pytest.raises(ValueError, match="365 to 1014"):
        refractive_index("lens", wavelength_nm)


def test_opticstudio_rays_are_reproduced_to_1e_8_mm():
    data = REFERENCE["opticstudio"]
    eye = opticstudio_eye(data["model"])
    for ray in data["rays"]:
        points = np.array(ray["points_cornea_front_to_retina"])
        points[:, 2] += eye.stop_z_mm
        # Field angles are positive where the light travels toward +x and +y.
        slopes = np.tan(np.radians(ray["field_deg"]))
        direction = np.array([*slopes, 1.0])
        traced = trace_rays(
            eye,
            start_mm=points[0] - 5.0 * direction,
            direction=direction,
            wavelength_nm=543.0,
        )
        assert traced.status_index[0] == RayStatus.TRACED
        assert np.abs(traced.points_mm[0] - points).max() < 1e-8, ray["field_deg"]


def test_reverse_rays_match_the_reference_at_every_surface():
    names = ("cornea_ant", "cornea_post", "stop", "lens_ant", "lens_post")
    n_rays = 0
    for case in REFERENCE["zernike_cases"]:
        eye = case_eye(REFERENCE, case)
        for ray in case.get("rays", ()):
            traced = trace_rays(
                eye,
                start_mm=case["retinal_point_mm"],
                direction=ray["dir_at_retina"],
                wavelength_nm=case["wavelength_nm"],
                reverse=True,
            )
            for element, name in enumerate(names):
                given = ray["surfaces"][name]
                # The file has ten digits, of which the start spends some on the way.
                point, path = traced.points_mm[0, element], traced.path_mm[0, element]
                assert np.abs(point - given["p"]).max() < 2e-8
                assert abs(path - given["opl"]) < 2e-8
                direction = traced.direction_ratio[0, element]
                assert np.abs(direction - given["d"]).max() < 2e-8
            n_rays += 1
    assert n_rays >= 40


def _compare_with_optiland(body, rays, points, directions, paths):
    traced = trace_rays(
        parsed_eye(body),
        start_mm=rays[:, :3],
        direction=rays[:, 3:],
        wavelength_nm=WAVELENGTH_NM,
    )
    assert np.all(traced.status_index == RayStatus.TRACED)
    assert np.abs(traced.points_mm - points).max() < 1e-12
    assert np.abs(traced.direction_ratio - directions).max() < 1e-13
    assert np.abs(traced.path_mm - paths).max() < 1e-12


def test_optiland_traced_a_random_eye_alike():
    data = json.loads(FROZEN.read_text(encoding="utf-8"))
    _compare_with_optiland(
        data["eye"],
        np.array(data["rays"]),
        np.array(data["points_mm"]),
        np.array(data["directions"]),
        np.array(data["paths_mm"]),
    )


@pytest.mark.filterwarnings("ignore")  # optiland's own
def test_optiland_traces_new_random_eyes_alike(rng):
    pytest.importorskip("optiland", reason="extra `crosscheck` is not installed")
    for _ in range(3):
        body, rays = random_eye(rng), random_rays(rng)
        points, directions, paths = trace_with_optiland(body, rays)
        complete = np.isfinite(points).all(axis=(1, 2))
        assert complete.sum() > 40
        _compare_with_optiland(
            body,
            rays[complete],
            points[complete],
            directions[complete],
            paths[complete],
        )


def _bundle(rng, count=40):
    angle, turn = rng.uniform(0.0, 40.0, count), rng.uniform(0.0, 2 * np.pi, count)
    sine = np.sin(np.radians(angle))
    direction = np.stack(
        [sine * np.cos(turn), sine * np.sin(turn), np.cos(np.radians(angle))], -1
    )
    aim = np.concatenate(
        [rng.uniform(-1.5, 1.5, (count, 2)), np.full((count, 1), 3)], 1
    )
    return aim - 12.0 * direction, direction


def test_light_goes_back_the_way_it_came(rng):
    eye = irregular_eye()
    start, direction = _bundle(rng)
    inward = trace_rays(eye, start_mm=start, direction=direction, wavelength_nm=500.0)
    assert np.all(inward.status_index == RayStatus.TRACED)
    outward = trace_rays(
        eye,
        start_mm=inward.points_mm[:, -1],
        direction=-inward.direction_ratio[:, -1],
        wavelength_nm=500.0,
        reverse=True,
    )
    assert np.all(outward.status_index == RayStatus.TRACED)
    assert np.abs(outward.points_mm - inward.points_mm).max() < 1e-12
    assert np.abs(outward.direction_ratio[:, 0] + direction).max() < 1e-13
    length = inward.path_mm[:, -1] - inward.path_mm[:, 0]
    assert np.abs(outward.path_mm[:, 0] - length).max() < 1e-12


def _sag_mm(surface, x, y):
    """The formula of an aspheric surface and textbook Zernike terms, written out."""
    rx, ry = surface.radius_mm
    k1 = 1.0 + surface.conic_constant
    root = np.sqrt(1.0 - k1 * (x**2 / rx**2 + y**2 / ry**2))
    sag = (x**2 / rx + y**2 / ry) / (1.0 + root)
    if surface.offset_mm is not None:
        u, v = x / surface.offset_radius_mm, y / surface.offset_radius_mm
        r2 = u**2 + v**2
        terms = {0: 1.0, 1: v, 2: u, 3: 2 * u * v, 4: 2 * r2 - 1, 5: u**2 - v**2}
        terms |= {7: (3 * r2 - 2) * v, 8: (3 * r2 - 2) * u, 12: 6 * r2**2 - 6 * r2 + 1}
        terms |= {24: 20 * r2**3 - 30 * r2**2 + 12 * r2 - 1}
        sag = sag + sum(surface.offset_mm[j] * value for j, value in terms.items())
    return sag


def test_points_lie_on_the_surfaces_and_obey_snell(rng):
    """Geometry of every option by independent formulas and numerical normals."""
    offset_mm = np.zeros(28)
    named = [0, 1, 2, 3, 4, 5, 7, 8, 12, 24]
    offset_mm[named] = rng.uniform(-0.03, 0.03, len(named))
    surface = Surface(
        (7.4, 8.1),
        -0.4,
        0.3,
        "cornea",
        rotation_deg=25.0,
        decentration_mm=(0.3, -0.2),
        tilt_deg=(4.0, -3.0),
        offset_mm=offset_mm,
        offset_radius_mm=5.8,
    )
    eye = EyeSurfaces((surface,), 3.0, Retina(12.0, 0.0, 24.0), {"cornea": 1.376})
    start, direction = _bundle(rng)
    traced = trace_rays(eye, start_mm=start, direction=direction, wavelength_nm=555.0)
    axes = rotation_matrix(rotation_deg=25.0, tilt_deg=(4.0, -3.0))
    local = (traced.points_mm[:, 0] - [0.3, -0.2, 0.3]) @ axes
    assert (
        np.abs(local[:, 2] - _sag_mm(surface, local[:, 0], local[:, 1])).max() < 1e-12
    )
    h = 1e-5
    x, y = local[:, 0], local[:, 1]
    slope_x = (_sag_mm(surface, x + h, y) - _sag_mm(surface, x - h, y)) / (2 * h)
    slope_y = (_sag_mm(surface, x, y + h) - _sag_mm(surface, x, y - h)) / (2 * h)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], -1) @ axes.T
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    after = traced.direction_ratio[:, 0]
    assert np.abs(np.linalg.norm(after, axis=1) - 1.0).max() < 1e-14
    change = np.cross(normal, 1.376 * after - direction)
    assert np.abs(change).max() < 1e-9  # as good as the numerical normals
    assert np.all(np.sum(after * normal, axis=1) > 0.0)


def test_axes_of_tilts_and_turns_are_right_handed():
    """About +x, y goes to z; about +y, z goes to x; about +z, x goes to y."""
    about_x = rotation_matrix(rotation_deg=0.0, tilt_deg=(90.0, 0.0))
    about_y = rotation_matrix(rotation_deg=0.0, tilt_deg=(0.0, 90.0))
    about_z = rotation_matrix(rotation_deg=90.0, tilt_deg=(0.0, 0.0))
    x, y, z = np.eye(3)
    assert np.allclose(about_x @ y, z)
    assert np.allclose(about_y @ z, x)
    assert np.allclose(about_z @ x, y)


def _one(eye, x_mm=0.0, y_mm=0.0, direction=(0.0, 0.0, 1.0)):
    start = np.array([x_mm, y_mm, -2.0])
    return trace_rays(eye, start_mm=start, direction=direction, wavelength_nm=555.0)


def test_failures_are_statuses_with_nan_behind_them():
    eye = irregular_eye()
    missed = _one(eye, x_mm=30.0)
    assert missed.status_index[0] == RayStatus.MISSED
    assert np.all(np.isnan(missed.points_mm))
    front, *rest = eye.surfaces
    clipped = _one(
        replace(
            eye, surfaces=(front, replace(rest[0], clear_radius_mm=1.0), *rest[1:])
        ),
        x_mm=1.5,
    )
    assert clipped.status_index[0] == RayStatus.CLIPPED
    assert np.all(np.isfinite(clipped.points_mm[0, 0]))
    assert np.all(np.isnan(clipped.points_mm[0, 1:]))


def test_total_reflection_is_told():
    """Inside a ball lens a steep ray cannot leave to a rarer medium."""
    ball = EyeSurfaces(
        (
            Surface((math.inf, math.inf), 0.0, 0.0, "lens"),
            Surface((-3.0, -3.0), 0.0, 5.0, "air"),
        ),
        1.0,
        Retina(12.0, 0.0, 20.0),
        {"lens": 1.8},
    )
    assert _one(ball, x_mm=0.5).status_index[0] == RayStatus.TRACED
    assert _one(ball, x_mm=2.5).status_index[0] == RayStatus.TOTAL_REFLECTION


def test_surfaces_that_cross_are_told():
    """Beyond its equator a thin lens has no thickness left."""
    lens = EyeSurfaces(
        (
            Surface((5.0, 5.0), 0.0, 0.0, "lens"),
            Surface((-5.0, -5.0), 0.0, 0.5, "vitreous"),
        ),
        0.2,
        Retina(12.0, 0.0, 20.0),
    )
    assert _one(lens, x_mm=0.5).status_index[0] == RayStatus.TRACED
    assert _one(lens, x_mm=3.0).status_index[0] == RayStatus.OUT_OF_ORDER


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0)])
def test_light_that_does_not_go_inwards_is_refused(direction):
    with pytest.raises(ValueError, match="positive z"):
        _one(irregular_eye(), direction=direction)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stop_z_mm": 30.0}, "stop at 30 mm"),
        ({"surfaces": ()}, "0 surfaces"),
        ({"retina": Retina(12.0, 0.0, 5.0)}, "retina at 5 mm"),
    ],
)
def test_an_eye_out_of_order_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        _one(replace(irregular_eye(), **change))


BODY = {
    "surfaces": [{"radius_mm": 7.8, "z_mm": 0, "medium_after": "aqueous"}],
    "stop_z_mm": 3.0,
    "retina": {"radius_mm": 12, "z_mm": 24},
}


def _with(**changes):
    surface = {**BODY["surfaces"][0], **changes.pop("surface", {})}
    return {**BODY, "surfaces": [surface], **changes}


def test_an_eye_by_surfaces_takes_every_documented_form():
    plain = parsed_eye(BODY)
    assert plain.surfaces[0].radius_mm == (7.8, 7.8)
    assert plain.indices is None
    flat = parsed_eye(_with(surface={"radius_mm": [None, 7.0]}))
    assert flat.surfaces[0].radius_mm == (math.inf, 7.0)
    terms = [0.001 * j for j in range(28)]
    whole = parsed_eye(_with(surface={"offset_mm": terms}))
    short = parsed_eye(_with(surface={"offset_mm": terms[1:]}))
    assert np.array_equal(whole.surfaces[0].offset_mm, short.surfaces[0].offset_mm)
    assert whole.surfaces[0].offset_mm[27] == terms[27]


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (_with(stop_z_mm=None), "stop_z_mm"),
        (_with(surface={"radius_mm": 0}), r"surfaces\.0\.radius_mm"),
        (_with(surface={"medium_after": "jelly"}), "medium_after"),
        (_with(surface={"offset_mm": [0.0] * 5}), "offset_mm"),
        (_with(surface={"color": 1}), "color"),
        (_with(indices={"aqueous": 0.5}), "indices.aqueous"),
        (_with(retina={"radius_mm": 12}), "retina.z_mm"),
        (_with(stop_z_mm=-3), "surfaces"),
    ],
)
def test_a_wrong_eye_by_surfaces_is_refused_by_field(body, field):
    with pytest.raises(ValueError, match=field):
        parsed_eye(body)
