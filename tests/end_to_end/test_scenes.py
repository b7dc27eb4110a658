"""The scenes: where things are, how frames look, that light is baked right."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from clients.scene_renderer import PATHS, SceneRenderer, look_at, path_moments
from clients.scenes import night_road, stairs
from clients.scenes.appearance import Baker, Lights
from clients.scenes.catalog import build_scene
from clients.scenes.geometry import (
    box,
    patch,
    placed,
    sphere,
    srgb_from_linear,
)
from clients.scenes.scene_view import LEAST_GAP_DPT, open_context
from filter_service.errors import RenderFailed

UNITS_PER_M = 180.0


@pytest.fixture(scope="module")
def courtyard():
    return build_scene("courtyard")


@pytest.fixture(scope="module")
def primitives():
    return build_scene("primitives")


@pytest.fixture(scope="module")
def primitives_frame(primitives):
    """Color, depth and the view ray (h, w, 3), z = -1, of every pixel's center."""
    size_px = (241, 135)
    with SceneRenderer(primitives, size_px, supersampling=1) as renderer:
        color, depth_m = renderer.render(np.eye(4))
    left, right, up, down = renderer.tangents
    x = left + (right - left) * (np.arange(size_px[0]) + 0.5) / size_px[0]
    y = up + (down - up) * (np.arange(size_px[1]) + 0.5) / size_px[1]
    xx, yy = np.meshgrid(x, y)
    return color, depth_m, np.stack([xx, yy, -np.ones_like(xx)], axis=-1)


def _ball_depth_m(rays):
    """Planar depth at which rays (h, w, 3), z = -1, meet the ball; NaN where not."""
    center = np.array([14, -3.5, -30]) / UNITS_PER_M
    radius = 8 / UNITS_PER_M
    # |s ray - center|^2 = radius^2, and s is the planar depth.
    a, b = (rays**2).sum(-1), rays @ center
    inside = b**2 - a * (center @ center - radius**2)
    return (b - np.sqrt(np.where(inside > 0, inside, np.nan))) / a


def test_ball_depth_is_where_the_pixels_rays_meet_it(primitives_frame):
    _, depth_m, rays = primitives_frame
    pitch_x, pitch_y = rays[0, 1, 0] - rays[0, 0, 0], rays[1, 0, 1] - rays[0, 0, 1]
    # An antialiased frame's depth is that of some sample within the pixel.
    within_pixel = [
        _ball_depth_m(rays + np.array([dx * pitch_x, dy * pitch_y, 0]))
        for dx in (-0.5, 0, 0.5)
        for dy in (-0.5, 0, 0.5)
    ]
    whole = np.isfinite(within_pixel).all(axis=0)
    assert whole.sum() > 4000
    nearest, farthest = np.min(within_pixel, axis=0), np.max(within_pixel, axis=0)
    # 64 flat sides dent the ball by r (1 - cos(pi/64)) = 0.054 mm across and as much
    # again up and down; along a ray that grazes it, by that over the cosine.
    center = np.array([14, -3.5, -30]) / UNITS_PER_M
    normal = rays * nearest[..., None] - center
    cosine = -(normal * rays).sum(-1) / (
        np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    )
    dent_m = 0.107e-3 / np.where(cosine > 0.1, cosine, 0.1)
    steep = whole & (cosine > 0.3)
    assert steep.sum() > 3500
    assert (depth_m >= nearest - 1e-5)[steep].all()
    assert (depth_m <= farthest + dent_m + 1e-5)[steep].all()


def test_letter_plane_is_at_4_17_m_and_cube_center_at_0_35(primitives_frame):
    _, depth_m, rays = primitives_frame
    height, width = depth_m.shape
    letter = depth_m[height // 3, width // 2]
    assert letter == pytest.approx(750 / UNITS_PER_M, abs=1e-3)
    toward = np.array([-31, -7, -63]) / 63
    row, column = np.unravel_index(
        np.argmin(((rays - toward) ** 2).sum(-1)), depth_m.shape
    )
    near, far = (63 - 11.5 * 3**0.5) / UNITS_PER_M, (63 - 11.5) / UNITS_PER_M
    assert near <= depth_m[row, column] <= far + 1e-3


def test_letter_reads_as_an_e_from_left_to_right_and_top_to_bottom(primitives_frame):
    color, _, rays = primitives_frame
    dark = color.max(-1) < 60

    def at(x_m, y_m):
        """Whether the plane is dark at a point of it, from its center."""
        point = np.array([x_m, y_m + 100 / UNITS_PER_M, 0]) / (750 / UNITS_PER_M)
        error = ((rays[..., :2] - point[:2]) ** 2).sum(-1)
        return dark[np.unravel_index(error.argmin(), error.shape)]

    unit = 2.44 / 8
    bars = [at(1.0 * unit, k * unit) for k in (2, 1, 0, -1, -2)]
    assert bars == [True, False, True, False, True]
    assert all(at(-2.0 * unit, k * unit) for k in (2, 1, 0, -1, -2))


def test_nearer_things_stand_left_and_right_as_published(primitives_frame):
    _, depth_m, _ = primitives_frame
    width = depth_m.shape[1]
    near = depth_m < 0.5
    assert np.flatnonzero((depth_m < 0.2).any(axis=0)).min() > width / 2
    left_part = depth_m[:, : width // 3]
    assert 0.2 < left_part[near[:, : width // 3]].min() < 0.35


def test_sky_is_infinitely_far_and_nothing_is_missing(courtyard):
    with SceneRenderer(courtyard, (96, 54)) as renderer:
        _, up_m = renderer.render(look_at((0, 1.2, 0), (0, 8.0, -3.0)))
        _, ahead_m = renderer.render(look_at((0, 1.2, 0), (0, 1.0, -4.0)))
    assert np.isposinf(up_m).mean() > 0.7
    for depth_m in (up_m, ahead_m):
        assert depth_m.dtype == np.float32
        assert (depth_m > 0).all()


def test_courtyard_path_spans_0_3_to_30_m_and_moves_eye_and_camera(courtyard):
    moments = path_moments(PATHS["courtyard"], 6)
    with SceneRenderer(courtyard, (160, 90)) as renderer:
        frames = [renderer.render(moment.pose) for moment in moments]
    depths = np.concatenate([depth_m.ravel() for _, depth_m in frames])
    finite = depths[np.isfinite(depths)]
    assert 0.25 < finite.min() < 0.5
    assert 28 < finite.max() < 33
    # A frame is a picture: many colors, neither crushed nor burnt out.
    for color, _ in frames:
        luminance = color.mean(-1)
        assert np.percentile(luminance, 95) - np.percentile(luminance, 5) > 90
        assert (color == 255).all(-1).mean() < 0.02
        assert (color < 8).all(-1).mean() < 0.05
    assert courtyard.n_triangles < 80_000


@pytest.mark.parametrize("name", sorted(PATHS))
def test_path_moves_everything_smoothly(name):
    moments = path_moments(PATHS[name], 48)
    poses = np.array([moment.pose for moment in moments])
    pupils_mm = np.array([moment.pupil_diameter_mm for moment in moments])
    foci_dpt = np.array([moment.focus_dpt for moment in moments])
    turns = poses[:, :3, :3]
    assert np.abs(turns.swapaxes(1, 2) @ turns - np.eye(3)).max() < 1e-12
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0 < steps_m.max() < 0.02
    assert np.ptp(pupils_mm) > 1
    assert np.ptp(foci_dpt) > 1
    assert foci_dpt.min() >= 0
    assert np.abs(np.diff(foci_dpt)).max() < 0.6


def test_path_goes_through_its_keys():
    keys = PATHS["courtyard"]
    moments = path_moments(keys, 2 * len(keys) - 1)[::2]
    for key, moment in zip(keys, moments, strict=True):
        assert moment.pose[:3, 3] == pytest.approx(key.position_m)
        assert moment.pupil_diameter_mm == pytest.approx(key.pupil_diameter_mm)
        assert moment.focus_dpt == pytest.approx(1 / key.focus_m)


def test_baked_sun_and_sky_are_shadowed_by_what_is_above():
    floor = patch((-2, 0, 2), (4, 0, 0), (0, 0, -4))
    plate = placed(box((1, 0.02, 1)), (0, 0.8, 0))
    sun, sky = np.array([1.0, 0.9, 0.8]), np.array([0.2, 0.3, 0.4])
    lights = Lights(
        sun_direction=np.array([0.0, 1.0, 0.0]),
        sun=sun,
        sky_zenith=sky,
        sky_horizon=sky,
        bounce=np.zeros(3),
        lamps_m=np.zeros((0, 3)),
        lamp=np.zeros(3),
    )
    points = np.array([[0.0, 0, 0], [1.5, 0, 1.5]])
    up = np.tile([0.0, 1.0, 0.0], (2, 1))
    bake = Baker(lights, [floor, plate], center_m=(0, 0.4, 0), radius_m=3.0)
    below, beside = bake.light(points, up)
    # The plate hides the sun wholly; of the sky, the cosine-weighted part of a square
    # straight above: 4 x its corner's form factor, for a half side of h = 0.5 / 0.8.
    h = 0.5 / 0.8
    side = h / np.hypot(1, h)
    hidden = 4 * (2 / (2 * np.pi)) * side * np.arctan(side)
    assert below == pytest.approx((1 - hidden) * sky, rel=0.1)
    assert (beside > 0.85 * (sun + sky)).all()
    assert (beside <= sun + sky + 1e-6).all()


def test_sphere_normals_point_outwards():
    ball = sphere(2.0)
    assert np.einsum("ij,ij->i", ball.normals, ball.vertices_m).min() > 1.9


def test_what_the_ball_hides_is_the_floor_and_the_walls_behind_it(primitives):
    """With the ball and the cube out of the scene, that is what is seen."""
    size_px = (121, 68)
    with SceneRenderer(primitives, size_px, supersampling=1) as renderer:
        (_, depth_m), (hidden, hidden_m) = renderer.render_layers(np.eye(4))
    without = replace(
        primitives,
        batches=tuple(b for b in primitives.batches if not _is_near(b)),
    )
    assert len(without.batches) < len(primitives.batches)
    with SceneRenderer(without, size_px, supersampling=1) as renderer:
        behind, behind_m = renderer.render(np.eye(4))
        seen = renderer.render_layers(np.eye(4))
    near = depth_m < 1.0
    assert near.mean() > 0.1
    # Antialiased silhouettes apart, where a sample of the ball is mixed in.
    inner = binary_erosion(near, iterations=2)
    shown = inner & (hidden_m > 1.0)
    assert shown.sum() > 0.95 * inner.sum()
    np.testing.assert_allclose(hidden_m[shown], behind_m[shown], rtol=1e-3)
    assert np.abs(hidden[shown].astype(int) - behind[shown]).mean() < 1.0
    gap = np.where(hidden_m > 0, 1 / depth_m - 1 / np.maximum(hidden_m, 1e-9), 1.0)
    assert gap.min() >= LEAST_GAP_DPT - 1e-6
    np.testing.assert_array_equal(seen[0][0], behind)  # peeling leaves no trace


def _is_near(batch):
    return -batch.vertices_m[:, 2].min() < 1.0


def test_a_renderer_leaves_no_context_current(primitives):
    with SceneRenderer(primitives, (8, 8)) as renderer:
        renderer.render(np.eye(4))
        assert not current_context()
    assert not current_context()


def current_context():
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetCurrentContext.restype = ctypes.c_void_p
    return egl.eglGetCurrentContext()


def test_without_opengl_the_command_that_helps_is_named(monkeypatch):
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libnothing.so")
    with pytest.raises(RenderFailed, match=r"libnothing\.so.*'ocufilter doctor'"):
        open_context()


def test_unknown_scene_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'kitchen'.*courtyard.*primitives"):
        build_scene("kitchen")


def test_empty_picture_is_refused(primitives):
    with pytest.raises(ValueError, match="0x90"):
        SceneRenderer(primitives, (0, 90))


def test_linear_images_hold_the_light_of_the_bytes(primitives):
    with SceneRenderer(primitives, (160, 90)) as renderer:
        encoded, depth_m = renderer.render(np.eye(4))
    with SceneRenderer(primitives, (160, 90), is_linear=True) as renderer:
        light, linear_m = renderer.render(np.eye(4))
    assert light.dtype == np.float32
    assert np.array_equal(depth_m, linear_m)
    # Samples are rounded to bytes, which weighs more in the dark part of a mixed pixel,
    # and their mean is rounded once more.
    difference = np.abs(255.0 * srgb_from_linear(light) - encoded)
    assert difference.max() < 1.5
    assert difference.mean() < 0.35


def test_lamps_light_the_eye_as_their_intensity_tells():
    """Illuminance of the headlamps of each oncoming car: twice intensity over d²."""
    scene = night_road.build()
    near = np.eye(4)
    near[:3, 3] = 0.0, night_road.EYE_HEIGHT_M, 0.0
    with SceneRenderer(scene, (960, 540), is_linear=True) as renderer:
        light, _ = renderer.render(near)
    left, right, up, down = renderer.tangents
    x = left + (right - left) * (np.arange(960) + 0.5) / 960
    y = up + (down - up) * (np.arange(540) + 0.5) / 540
    pixel_sr = (right - left) * (up - down) / light[..., 0].size
    luminance = night_road.WHITE_CD_M2 * light @ (0.2126, 0.7152, 0.0722)
    height = night_road.LAMP_HEIGHT_M - night_road.EYE_HEIGHT_M
    for distance_m in night_road.CAR_DISTANCES_M[:1]:
        at_x = night_road.ONCOMING_X_M / distance_m
        wide = (night_road.HALF_TRACK_M + 0.2) / distance_m
        columns = np.abs(x - at_x) < wide
        rows = np.abs(y - height / distance_m) < 0.2 / distance_m
        lamps = luminance[np.ix_(rows, columns)]
        lux = lamps[lamps > 100.0].sum() * pixel_sr
        expected = 2.0 * night_road.LOW_BEAM_CD / distance_m**2
        assert lux == pytest.approx(expected, rel=0.1)  # few samples across a lamp
    assert luminance.max() > 10_000.0
    assert 0.2 < np.median(luminance[y < -0.1]) < 3.0  # a lit road


@pytest.mark.clients
def test_edges_of_the_stairs_are_where_they_are_said_to_be():
    scene = build_scene("stairs")
    pose = look_at((0, 0, 0), (0, -0.84, -1.0))
    with SceneRenderer(scene, (128, 512), supersampling=1) as renderer:
        color, depth_m = renderer.render(pose)
    assert np.isfinite(depth_m).all()
    assert ((color > 250).all(-1)).mean() < 0.05
    _, _, up, down = renderer.tangents
    middle_m = depth_m[:, 64]
    for step in range(4, 10):
        y, z = stairs.edge_m(step)
        depth = -np.array([0.0, y, z]) @ pose[:3, 2]
        tangent = np.array([0.0, y, z]) @ pose[:3, 1] / depth
        row = (up - tangent) / (up - down) * 512
        # A tread ends here, and the step beyond it is farther away.
        before, after = middle_m[round(row) + 2], middle_m[round(row) - 3]
        assert before == pytest.approx(depth, abs=0.03)
        assert after > depth + 0.04
