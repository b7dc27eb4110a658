"""Scenes for a headset that come from files, and where to stand."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from clients.headset.gltf_scene import BACKGROUND_SRGB, light_on, load_gltf
from clients.headset.scenery import EYE_HEIGHT_M, viewpoint
from clients.scene_renderer import PATHS, path_moments
from clients.scenes.geometry import Scene, rotation, srgb_from_linear

ONE_TO_ONE = (-1.0, 1.0, 1.0, -1.0)


# ----- files


def quad(*, normals=True, **fields):
    """A square of 2 m at z = 0 that faces +z."""
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    return trimesh.Trimesh(
        vertices=np.array(corners, float),
        faces=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=np.tile([0.0, 0.0, 1.0], (4, 1)) if normals else None,
        process=False,
        **fields,
    )


def write_gltf(path, nodes, *, change=None):
    """Write meshes [(mesh, matrix), ...]; `change` edits the file's header."""
    scene = trimesh.Scene()
    for mesh, matrix in nodes:
        scene.add_geometry(mesh, transform=matrix)
    scene.export(
        str(path),
        include_normals=True,
        **({"tree_postprocessor": change} if change else {}),
    )
    return path


def as_unlit(tree):
    for material in tree.setdefault("materials", [{}]):
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive.setdefault("material", 0)


def at(x=0.0, y=0.0, z=0.0, matrix=None):
    placed = np.eye(4) if matrix is None else matrix.copy()
    placed[:3, 3] = x, y, z
    return placed


def test_a_textured_square_shows_its_texels_and_where_it_is(show, tmp_path):
    texels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [90, 90, 90]]], "u1")
    image = Image.fromarray(texels.repeat(32, axis=0).repeat(32, axis=1))
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    look = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=image))
    file = write_gltf(
        tmp_path / "square.glb", [(quad(visual=look), at(z=-2))], change=as_unlit
    )
    scene = load_gltf(file)
    assert scene.name == "square.glb"
    color, depth_m = show(scene, np.eye(4), ONE_TO_ONE, (16, 16))
    np.testing.assert_allclose(depth_m[4:12, 4:12], 2.0, rtol=1e-6)
    assert np.isposinf(depth_m[:4]).all()
    assert np.isposinf(depth_m[:, 12:]).all()
    assert np.array_equal(color[5:11:5, 5:11:5], texels)
    assert (color[0] == round(255 * BACKGROUND_SRGB[0])).all()


def test_nodes_place_and_turn_a_mesh_each_for_itself(show, tmp_path):
    colors = np.tile(np.array([200, 100, 50, 255], np.uint8), (4, 1))
    mirrored = rotation("y", 60.0) @ np.diag([-0.5, 0.5, 0.5, 1.0])
    nodes = [
        (quad(vertex_colors=colors), at(-1, 0, -3)),
        (quad(), at(1, 0.5, -4, mirrored)),
    ]
    scene = load_gltf(write_gltf(tmp_path / "two.gltf.glb", nodes))
    _, depth_m = show(scene, np.eye(4), ONE_TO_ONE, (120, 120), supersampling=1)
    # the middle of each, and the slope of the turned one: z = -4 - tan(60) (x - 1)
    assert depth_m[60, 40] == pytest.approx(3.0, rel=1e-5)
    x = (np.arange(120) + 0.5) / 60 - 1
    column = int(np.argmin(np.abs(x - 0.25)))
    z = (4 - np.tan(np.deg2rad(60))) / (1 - np.tan(np.deg2rad(60)) * x[column])
    assert depth_m[52, column] == pytest.approx(z, rel=1e-4)


@pytest.mark.parametrize("is_unlit", [False, True])
def test_vertex_colors_and_factors_are_lit_once(show, tmp_path, is_unlit):
    tint, factor = np.array([200, 100, 50]) / 255, np.array([102, 204, 255]) / 255
    material = PBRMaterial(baseColorFactor=[102, 204, 255, 255])
    look = TextureVisuals(material=material)
    look.vertex_attributes["color"] = np.tile([200, 100, 50, 255], (4, 1)).astype("u1")
    mesh = quad(visual=look)
    change = as_unlit if is_unlit else None
    scene = load_gltf(write_gltf(tmp_path / "a.glb", [(mesh, at(z=-1))], change=change))
    color, _ = show(scene, np.eye(4), (-0.5, 0.5, 0.5, -0.5), (8, 8))
    light = 1.0 if is_unlit else light_on(np.array([[0.0, 0.0, 1.0]]))[0]
    expected = 255 * srgb_from_linear(tint * factor * light)
    np.testing.assert_allclose(color[4, 4], expected, atol=1.0)


def test_light_comes_from_above_and_burns_nothing_out(rng):
    normals = rng.normal(size=(5000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = light_on(normals)
    assert 0.0 < light.min() < light.max() <= 1.0
    up, down = light_on(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))
    assert (up > 2 * down).all()


def test_a_file_without_normals_has_flat_faces(tmp_path):
    box = trimesh.creation.box((1, 1, 1))

    def drop_normals(tree):
        for mesh in tree["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["attributes"].pop("NORMAL", None)

    scene = load_gltf(
        write_gltf(tmp_path / "b.glb", [(box, at())], change=drop_normals)
    )
    (batch,) = scene.batches
    per_face = batch.srgb[batch.faces]
    assert np.ptp(per_face, axis=1).max() < 1e-6
    assert len(np.unique(np.round(per_face[:, 0], 4), axis=0)) >= 5


def test_what_is_blended_away_is_left_out(tmp_path):
    glass = quad(
        visual=TextureVisuals(
            material=PBRMaterial(baseColorFactor=[255, 255, 255, 51], alphaMode="BLEND")
        )
    )
    scene = load_gltf(
        write_gltf(tmp_path / "c.glb", [(glass, at(z=1)), (quad(), at())])
    )
    assert scene.n_triangles == 2


def test_a_file_that_cannot_be_shown_is_named_with_the_reason(tmp_path, monkeypatch):
    def refused(reason, name, content=None):
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=reason) as caught:
            load_gltf(path)
        assert str(path) in str(caught.value)

    good = write_gltf(tmp_path / "good.glb", [(quad(), at())]).read_bytes()
    refused("no such file", "absent.glb")
    refused("not a glTF", "text.glb", b"solid cube")
    refused("not a glTF", "list.gltf", b"[1, 2]")
    refused("not a glTF", "short.glb", good[:30])
    refused("glTF 1.0; allowed: glTF 2", "old.gltf", b'{"asset": {"version": "1.0"}}')
    refused("no triangles", "empty.gltf", b'{"asset": {"version": "2.0"}}')
    refused("damaged", "cut.glb", good[:-60])
    need = b'{"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_x"]}'
    refused("extension KHR_x", "extension.gltf", need)
    write_gltf(tmp_path / "huge.glb", [(quad(), np.diag([9e3, 9e3, 1.0, 1.0]))])
    refused("m across", "huge.glb")
    monkeypatch.setattr("clients.headset.gltf_scene.MAX_TRIANGLES", 1)
    refused("2 triangles", "good.glb")
    monkeypatch.setattr("clients.headset.gltf_file.MAX_FILE_MB", 1e-5)
    refused("at most 1e-05 MB", "good.glb")


# ----- places


def test_a_viewer_stands_in_a_place_and_before_a_thing(tmp_path):
    def place(mesh):
        scene = load_gltf(write_gltf(tmp_path / "place.glb", [(mesh, at())]))
        pose = viewpoint(scene)
        assert np.array_equal(pose[:3, :3], np.eye(3))
        corners = mesh.bounds[[0, 1]]
        far_m = pose[2, 3] - corners[:, 2].min()
        assert scene.near_m < far_m < scene.far_m
        return pose[:3, 3]

    room = trimesh.creation.box((6, 3, 8))
    room.apply_translation((1, 1.5, -2))
    np.testing.assert_allclose(place(room), (1, EYE_HEIGHT_M, 0))
    cup = trimesh.creation.box((0.1, 0.1, 0.1))
    cup.apply_translation((0, 0.05, 0))
    np.testing.assert_allclose(place(cup), (0, 0.05, 0.4))
    ship = trimesh.creation.box((30, 20, 10))
    x, y, z = place(ship)
    assert (x, y) == (0, 0)
    assert z > 20 / 2 + 10 / 2


def test_in_our_own_scenes_a_viewer_stands_where_the_path_begins():
    scene = Scene("courtyard", (), BACKGROUND_SRGB, 0.1, 9.0, 9.0)
    expected = path_moments(PATHS["courtyard"], 5)[0].pose
    np.testing.assert_allclose(viewpoint(scene), expected)
