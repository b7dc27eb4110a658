"""Rendering of scenes: color, depth, the hidden layer, and the edges of an image."""

import moderngl
import numpy as np
import pytest

from clients.scene_renderer import PATHS, look_at, path_moments
from clients.scenes.catalog import build_scene
from clients.scenes.geometry import (
    Scene,
    finished,
    linear_from_hex,
    patch,
    placed,
    rotation,
    srgb_from_linear,
    transformed,
)
from clients.scenes.scene_view import LEAST_GAP_DPT, SceneView

SIZE_PX = (320, 180)
ONE_TO_ONE = (-1.0, 1.0, 1.0, -1.0)


def psnr_db(a, b):
    error = np.mean((a.astype(float) - b.astype(float)) ** 2)
    return 10 * np.log10(255**2 / max(error, 1e-9))


def same_depth(a_m, b_m, tolerance=1e-4):
    """Where two depths are the same, infinity included."""
    with np.errstate(invalid="ignore"):
        return (a_m == b_m) | (np.abs(a_m - b_m) <= tolerance * np.minimum(a_m, b_m))


@pytest.mark.parametrize(
    "name", ["primitives", pytest.param("courtyard", marks=pytest.mark.clients)]
)
def test_edges_that_are_not_symmetric_cut_out_a_part(name, show):
    scene = build_scene(name)
    pose = path_moments(PATHS[name], 5)[1].pose
    left, right, up, down = -0.8, 0.8, 0.45, -0.45
    whole, whole_m = show(scene, pose, (left, right, up, down), SIZE_PX)
    columns, rows = (100, 260), (20, 110)
    pitch_x, pitch_y = (right - left) / SIZE_PX[0], (up - down) / SIZE_PX[1]
    tangents = (
        *(left + pitch_x * column for column in columns),
        *(up - pitch_y * row for row in rows),
    )
    color, depth_m = show(scene, pose, tangents, (160, 90))
    inside = slice(*rows), slice(*columns)
    assert same_depth(depth_m, whole_m[inside]).mean() >= 0.999
    assert psnr_db(color, whole[inside]) >= 45.0


# ----- what a picture is, on scenes of one or two surfaces


def scene_of(*meshes, textures=None, **fields):
    """A scene in which every surface is as bright as its color."""
    batches = tuple(
        finished(mesh, np.ones((len(mesh.vertices_m), 3)), textures or {})
        for mesh in meshes
    )
    fields = {"near_m": 0.1, "far_m": 100.0, "infinite_from_m": 50.0} | fields
    return Scene(
        name="test", batches=batches, background_srgb=(0.2, 0.4, 0.6), **fields
    )


def square(center_m, side_m, color="#ffffff", **look):
    x, y, z = center_m
    origin = (x - side_m / 2, y - side_m / 2, z)
    return patch(origin, (side_m, 0, 0), (0, side_m, 0), color=color, **look)


def test_the_background_is_its_color_and_at_infinity(show):
    color, depth_m = show(
        scene_of(square((0, 0, -60), 200)), np.eye(4), ONE_TO_ONE, (8, 6)
    )
    assert (color == 255).all()  # a surface, but as good as infinitely far
    assert np.isposinf(depth_m).all()
    behind = scene_of(square((0, 0, 1), 1))
    color, depth_m = show(behind, np.eye(4), ONE_TO_ONE, (8, 6))
    assert (color == np.round(255 * np.array(behind.background_srgb))).all()
    assert np.isposinf(depth_m).all()


def test_both_sides_of_a_surface_are_shown_the_right_way_up(show):
    texels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], "u1")
    large = texels.repeat(16, axis=0).repeat(16, axis=1)
    scene = scene_of(square((0, 0, -2), 4, texture="t"), textures={"t": large})
    color, depth_m = show(scene, np.eye(4), ONE_TO_ONE, (16, 16))
    corners = color[2::12, 2::12]
    assert np.array_equal(corners, texels)
    np.testing.assert_allclose(depth_m, 2.0, rtol=1e-6)
    turned = look_at((0, 0, -4), (0, 0, 0))
    assert np.array_equal(show(scene, turned, ONE_TO_ONE, (16, 16))[0], color[:, ::-1])


def test_depth_is_planar_and_exact_far_away(show):
    floor = patch((-500, -1, 0), (1000, 0, 0), (0, 0, -1000))
    scene = scene_of(floor, near_m=0.05, far_m=2000.0, infinite_from_m=900.0)
    _, depth_m = show(
        scene, np.eye(4), (-0.1, 0.1, 0.0, -0.1), (4, 80), supersampling=1
    )
    tangent = 0.1 * (np.arange(80) + 0.5) / 80
    expected_m = np.broadcast_to(1.0 / tangent[:, None], depth_m.shape)
    np.testing.assert_allclose(depth_m[1:], expected_m[1:], rtol=1e-5)


@pytest.mark.parametrize(
    ("covered_ratio", "is_near"), [(0.25, False), (0.5, True), (0.75, True)]
)
def test_a_pixels_light_is_the_mean_and_its_depth_is_one_samples(
    show, covered_ratio, is_near
):
    # 4 pixels of tangent 0.5; what is near reaches into the third, from the left
    samples = round(4 * covered_ratio)
    columns, rows = (1, 1) if samples == 1 else (1, 2)
    near = [patch((-1, -1, -1), (1 + 0.25 * columns, 0, 0), (0, 1 + 0.25 * rows, 0))]
    if samples == 3:
        near.append(patch((-1, -1, -1), (1.5, 0, 0), (0, 1.25, 0)))
    scene = scene_of(*near, square((0, 0, -2), 8, "#000000"))
    color, depth_m = show(scene, np.eye(4), ONE_TO_ONE, (4, 4))
    srgb = 255 * srgb_from_linear(np.array(covered_ratio))
    np.testing.assert_allclose(color[1, 2], srgb, atol=1.0)
    assert depth_m[1, 2] == pytest.approx(1.0 if is_near else 2.0, rel=1e-6)
    assert depth_m[3, 0] == pytest.approx(1.0, rel=1e-6)
    assert depth_m[0, 3] == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("n_covered", [1, 2, 4])
def test_hidden_pixels_are_the_samples_that_show_something(context, n_covered):
    """A plate covers samples of the pixel at the center; a wall is behind it."""
    columns, rows = {1: (1, 1), 2: (1, 2), 4: (2, 2)}[n_covered]
    # Pixels have a tangent of 0.5, samples of 0.25.
    plate = patch((-1, -1, -1), (1 + 0.25 * columns, 0, 0), (0, 1 + 0.25 * rows, 0))
    scene = scene_of(plate, square((0, 0, -2), 8, "#808080"))
    with SceneView(context, scene, (4, 4)) as view:
        (_, seen_m), (hidden, hidden_m) = view.render_layers(np.eye(4), ONE_TO_ONE)
    # Where the wall is visible, the background is hidden, at infinity.
    assert seen_m[0, 3] == pytest.approx(2.0)
    assert np.isposinf(hidden_m[0, 3])
    background = 255 * np.array(scene.background_srgb)
    np.testing.assert_allclose(hidden[0, 3], background, atol=1.0)
    # Where the plate is visible, the wall is hidden.
    assert seen_m[3, 0] == pytest.approx(1.0)
    assert hidden_m[3, 0] == pytest.approx(2.0)
    np.testing.assert_allclose(hidden[3, 0], 128, atol=1.0)
    # In the pixel at the plate's edge, each sample shows what is behind its surface.
    linear = linear_from_srgb8(np.array([128] * 3))
    behind = linear_from_srgb8(np.round(background).astype(int))
    mean = (n_covered * linear + (4 - n_covered) * behind) / 4
    np.testing.assert_allclose(hidden[1, 2], 255 * srgb_from_linear(mean), atol=1.5)
    expected_m = 2.0 if n_covered >= 2 else np.inf
    assert hidden_m[1, 2] == pytest.approx(expected_m)


def test_a_surface_close_behind_the_visible_one_is_not_hidden(context):
    for gap_dpt, is_hidden in ((0.9, False), (1.1, True)):
        wall_m = 1.0 / (1.0 - gap_dpt * LEAST_GAP_DPT)
        scene = scene_of(square((0, 0, -1), 8), square((0, 0, -wall_m), 8))
        with SceneView(context, scene, (4, 4)) as view:
            _, (_, hidden_m) = view.render_layers(np.eye(4), ONE_TO_ONE)
        expected_m = wall_m if is_hidden else np.inf
        assert hidden_m[1, 1] == pytest.approx(expected_m)


def test_two_eyes_see_a_point_apart_by_their_distance_over_its_own(show):
    # a square that faces a head that is turned
    head = rotation("y", 25.0)
    # oblique to the samples' rows, which would round its edges
    oblique = transformed(square((0, 0, 0), 0.1), rotation("z", 10.0))
    shapes = placed(oblique, (0.05, 0.02, -1.5)), square((0, 0, -9), 99, "#000000")
    scene = scene_of(*(transformed(shape, head) for shape in shapes))
    columns = []
    for side in (-1, 1):
        pose = head.copy()
        pose[:3, 3] = pose[:3, 0] * side * 0.0315
        # the edges of a headset: wide toward the temple, mirrored in the other eye
        left, right = (-1.2, 0.9) if side < 0 else (-0.9, 1.2)
        color, _ = show(
            scene, pose, (left, right, 1.1, -1.0), (400, 400), supersampling=6
        )
        light = linear_from_srgb8(color[..., 0])
        x = left + (right - left) * (np.arange(400) + 0.5) / 400
        columns.append((light.sum(axis=0) @ x) / light.sum())
    assert columns[0] - columns[1] == pytest.approx(0.063 / 1.5, abs=1e-4)
    assert np.mean(columns) == pytest.approx(0.05 / 1.5, abs=1e-4)


def linear_from_srgb8(values):
    table = [linear_from_hex(f"#{v:02x}{v:02x}{v:02x}")[0] for v in range(256)]
    return np.array(table)[values]


# ----- the view as an object


def test_other_contexts_of_the_thread_go_on(context):
    other = moderngl.create_context(standalone=True, require=330, backend="egl")
    scene = scene_of(square((0, 0, -2), 4))
    try:
        with other:
            buffer = other.buffer(b"mine")
        with SceneView(context, scene, (8, 8)) as view:
            color, _ = view.render(np.eye(4), ONE_TO_ONE)
            with other:
                assert buffer.read() == b"mine"
            assert np.array_equal(view.render(np.eye(4), ONE_TO_ONE)[0], color)
        with other:
            assert buffer.read() == b"mine"
            assert other.error == "GL_NO_ERROR"
    finally:
        other.release()


def test_what_the_context_was_set_to_does_not_show(context):
    scene = scene_of(square((0, 0, -2), 1, "#808080"))
    with SceneView(context, scene, (8, 8)) as view:
        expected = view.render(np.eye(4), ONE_TO_ONE)
        with context:
            context.enable(moderngl.CULL_FACE | moderngl.BLEND)
            context.enable_direct(0x8DB9)  # GL_FRAMEBUFFER_SRGB
        got = view.render(np.eye(4), ONE_TO_ONE)
        with context:
            context.enable_only(moderngl.NOTHING)
    assert all(np.array_equal(a, b) for a, b in zip(got, expected, strict=True))


def test_a_closed_view_holds_nothing(context):
    view = SceneView(context, scene_of(square((0, 0, -2), 1)), (8, 8))
    held = list(view._owned)
    assert held
    view.close()
    view.close()
    assert all(isinstance(each.mglo, moderngl.InvalidObject) for each in held)


def test_a_view_refuses_what_is_no_picture(context):
    scene = scene_of(square((0, 0, -2), 1))
    with pytest.raises(ValueError, match="1 or more"):
        SceneView(context, scene, (0, 8))
    with pytest.raises(ValueError, match="renders up to"):
        SceneView(context, scene, (100_000, 8))
    with SceneView(context, scene, (8, 8)) as view:
        for tangents in ((1, -1, 1, -1), (-1, 1, -1, 1), (-1, np.nan, 1, -1)):
            with pytest.raises(ValueError, match="tangents"):
                view.render(np.eye(4), tangents)
        for pose in (np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4)):
            with pytest.raises(ValueError, match="pose"):
                view.render(pose, ONE_TO_ONE)
