"""Frames of pyrender scenes: closed forms, the project's own renderer, the service."""

import ctypes
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.transformations import rotation_matrix, translation_matrix

from clients.filter_client import FilterClient
from clients.frame_log import FrameLog
from clients.pyrender_renderer import (
    BUILT_IN_FLAGS,
    MAX_PARTS,
    PyrenderRenderer,
    built_in,
    camera_tangents,
    load_file,
    orbit,
    pyrender,
    pyrender_frames,
)
from clients.scene_renderer import Moment, SceneRenderer, look_at
from clients.scenes.catalog import build_scene
from clients.scenes.geometry import Batch, Scene
from clients.streaming import filter_in_order
from estimator import InvalidFile
from filter_service.messages import State
from tests.source_tree import ROOT

pytestmark = pytest.mark.clients

SIZE_PX = (160, 90)
NEAR_M, FAR_M = 0.05, 100.0
SKY_SRGB = (0.2, 0.3, 0.4)
FLAT = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
CAMERAS = {
    "infinite": pyrender.PerspectiveCamera(np.deg2rad(50.0), znear=NEAR_M),
    "finite": pyrender.PerspectiveCamera(np.deg2rad(50.0), znear=NEAR_M, zfar=FAR_M),
    # Without a zfar, this camera has one of 100 m.
    "off_center": pyrender.IntrinsicsCamera(fx=150.0, fy=140.0, cx=95.0, cy=40.0),
}
EYES = {"pupil_range_mm": (3.0, 5.0), "focus_range_dpt": (0.0, 2.0)}


def textured_sphere(radius_m):
    """A sphere with a smooth texture, red in one direction and green across it."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    uv = 0.5 + 0.4 * sphere.vertices[:, :2] / radius_m
    ramp = np.linspace(40, 220, 64).astype(np.uint8)
    texels = np.stack(np.broadcast_arrays(ramp[None], ramp[:, None], 90), axis=-1)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(texels.astype(np.uint8))
    )
    sphere.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return sphere


def colored(mesh, seed):
    """The mesh with a color per vertex."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(60, 255, (len(mesh.vertices), 3))
    mesh.visual.vertex_colors = np.insert(rgb, 3, 255, axis=1).astype(np.uint8)
    return mesh


def three_meshes():
    """A box, a sphere with a color per vertex, and a textured one, side by side."""
    box = colored(trimesh.creation.box((0.5, 0.5, 0.5)), 1)
    box.apply_transform(rotation_matrix(0.6, (0.3, 1.0, 0.2)))
    ball = colored(trimesh.creation.icosphere(subdivisions=3, radius=0.3), 2)
    globe = textured_sphere(0.25)
    for mesh, x_m in ((box, -0.65), (ball, 0.0), (globe, 0.65)):
        mesh.apply_translation((x_m, 0.05, 0.0))
    return [box, ball, globe]


def pyrender_scene(meshes):
    scene = pyrender.Scene(bg_color=[*SKY_SRGB, 1.0])
    for mesh in meshes:
        scene.add(pyrender.Mesh.from_trimesh(mesh))
    return scene


def own_scene(meshes):
    """The meshes for the project's own renderer, converted without pyrender."""
    batches = []
    for mesh in meshes:
        texture, uv = None, np.zeros((len(mesh.vertices), 2), np.float32)
        srgb = np.ones((len(mesh.vertices), 3), np.float32)
        if mesh.visual.kind == "texture":
            texture = np.asarray(mesh.visual.material.baseColorTexture)
            uv = mesh.visual.uv.astype(np.float32)
        else:
            srgb = mesh.visual.vertex_colors[:, :3].astype(np.float32) / 255.0
        batches.append(
            Batch(
                vertices_m=mesh.vertices.astype(np.float32),
                faces=mesh.faces.astype(np.uint32),
                uv=uv,
                srgb=srgb,
                texture=texture,
            )
        )
    return Scene("meshes", tuple(batches), SKY_SRGB, NEAR_M, FAR_M, FAR_M)


def rays_of(tangents):
    """The directions (h, w, 3), z = -1, of the pixel centers."""
    width_px, height_px = SIZE_PX
    left, right, up, down = tangents
    x = left + (right - left) * (np.arange(width_px) + 0.5) / width_px
    y = up + (down - up) * (np.arange(height_px) + 0.5) / height_px
    return np.stack(np.broadcast_arrays(x[None], y[:, None], -1.0), axis=-1)


def psnr_db(image, reference):
    error = np.square(image.astype(float) - reference).mean()
    return 10.0 * np.log10(255.0**2 / error)


def rendered(scene, camera, pose=None, **options):
    with PyrenderRenderer(scene, SIZE_PX, **options) as renderer:
        return renderer.render(camera, np.eye(4) if pose is None else pose)


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_depth_is_where_each_pixels_ray_meets_a_tilted_plane(name):
    camera = CAMERAS[name]
    plane = trimesh.creation.box((80.0, 80.0, 0.2))
    turn = rotation_matrix(0.5, (0.4, 1.0, 0.0))
    plane.apply_transform(translation_matrix((0.0, 0.0, -3.0)) @ turn)
    _, depth_m = rendered(pyrender_scene([plane]), camera, supersampling=1)
    normal = turn[:3, 2]
    point = np.array((0.0, 0.0, -3.0)) + 0.1 * normal  # on the side of the camera
    rays = rays_of(camera_tangents(camera, SIZE_PX))
    truth_m = (point @ normal) / (rays @ normal)
    assert truth_m.min() < 2.5
    assert truth_m.max() > 4.0
    # The depth buffer has 24 bits: z^2 / (2^24 znear).
    np.testing.assert_allclose(depth_m, truth_m, rtol=1e-5, atol=5e-5)


def test_principal_point_is_where_the_axis_meets_the_image():
    camera = CAMERAS["off_center"]
    assert camera_tangents(camera, SIZE_PX) == pytest.approx(
        (-95 / 150, 65 / 150, 40 / 140, -50 / 140)
    )
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    small.apply_translation((0.0, 0.0, -2.0))
    _, depth_m = rendered(pyrender_scene([small]), camera, supersampling=4)
    rows, columns = np.nonzero(np.isfinite(depth_m))
    assert columns.mean() + 0.5 == pytest.approx(95.0, abs=0.2)
    assert rows.mean() + 0.5 == pytest.approx(40.0, abs=0.2)


@pytest.mark.parametrize(("name", "seen_m"), [("infinite", 150.0), ("finite", None)])
def test_what_is_beyond_the_far_plane_is_background(name, seen_m):
    wall = trimesh.creation.box((400.0, 60.0, 2.0))
    wall.apply_translation((0.0, 0.0, -151.0))
    scene = pyrender_scene([wall])
    color, depth_m = rendered(scene, CAMERAS[name], flags=FLAT)
    assert depth_m.dtype == np.float32
    assert np.isposinf(depth_m[0]).all()  # above the wall
    if seen_m is None:
        assert np.isposinf(depth_m).all()
        assert np.abs(color - 255.0 * np.array(SKY_SRGB)).max() <= 1.0
    else:
        assert depth_m[45, 80] == pytest.approx(seen_m, rel=2e-3)
        _, depth_m = rendered(scene, CAMERAS[name], infinite_from_m=100.0)
        assert np.isposinf(depth_m).all()


def test_an_intrinsics_camera_ends_at_100_m_unless_it_is_told():
    wall = trimesh.creation.box((400.0, 400.0, 2.0))
    wall.apply_translation((0.0, 0.0, -151.0))
    scene = pyrender_scene([wall])
    _, depth_m = rendered(scene, CAMERAS["off_center"])
    assert np.isposinf(depth_m).all()
    far = pyrender.IntrinsicsCamera(150.0, 140.0, 95.0, 40.0, zfar=1000.0)
    _, depth_m = rendered(scene, far)
    np.testing.assert_allclose(depth_m, 150.0, rtol=2e-3)


@pytest.mark.parametrize("name", sorted(CAMERAS))
@pytest.mark.parametrize("which", ["box", "ball", "globe", "all"])
def test_picture_equals_that_of_the_own_renderer(show, which, name):
    names = ("box", "ball", "globe", "all")
    meshes = three_meshes()
    if which != "all":
        meshes = [meshes[names.index(which)]]
    camera, pose = CAMERAS[name], look_at((0.3, 0.4, 2.0), (0.0, 0.0, 0.0))
    tangents = camera_tangents(camera, SIZE_PX)
    own, own_m = show(own_scene(meshes), pose, tangents, SIZE_PX, supersampling=3)
    color, depth_m = rendered(pyrender_scene(meshes), camera, pose, flags=FLAT)
    seen = np.isfinite(own_m)
    assert seen.mean() > 0.02
    assert (np.isfinite(depth_m) == seen).mean() >= 0.999
    both = seen & np.isfinite(depth_m)
    difference_m = np.abs(depth_m[both] - own_m[both])
    assert (difference_m <= 1e-4).sum() >= 0.995 * seen.sum()
    assert psnr_db(color, own) >= 40.0


@pytest.mark.parametrize("name", ["primitives", "courtyard"])
def test_built_in_scenes_look_alike_in_both_renderers(name):
    """Also where single sheets, such as leaves, show their backs."""
    scene, pose = build_scene(name), np.eye(4)
    if name == "courtyard":
        pose = look_at((0.0, 1.2, 0.0), (0.0, 1.0, -4.0))
    with SceneRenderer(scene, SIZE_PX) as renderer:
        own, own_m = renderer.render(pose)
    converted, camera = built_in(scene)
    color, depth_m = rendered(
        converted,
        camera,
        pose,
        flags=BUILT_IN_FLAGS,
        infinite_from_m=scene.infinite_from_m,
    )
    assert (np.abs(1.0 / depth_m - 1.0 / own_m) < 1e-4).mean() >= 0.995
    assert psnr_db(color, own) >= 40.0


def test_both_sides_of_a_sheet_have_a_depth():
    """pyrender's passes for depth alone and for segments leave out back faces."""
    sheet = trimesh.Trimesh([(-1, -1, -2), (1, -1, -2), (0, 1, -2)], [(0, 2, 1)])
    assert (sheet.face_normals[0] == (0, 0, -1)).all()
    scene = pyrender_scene([sheet])
    _, depth_m = rendered(scene, CAMERAS["finite"], flags=FLAT)
    assert depth_m[45, 80] == pytest.approx(2.0, abs=1e-4)
    _, depth_m = rendered(scene, CAMERAS["finite"], flags=pyrender.RenderFlags.FLAT)
    assert np.isposinf(depth_m).all()


def current_context():
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetCurrentContext.restype = ctypes.c_void_p
    return egl.eglGetCurrentContext()


def test_renderers_in_one_process_leave_each_other_alone():
    meshes = three_meshes()
    camera, pose = CAMERAS["finite"], look_at((0.3, 0.4, 2.0), (0.0, 0.0, 0.0))
    with SceneRenderer(own_scene(meshes), SIZE_PX) as own:
        alone, _ = own.render(pose)
        with PyrenderRenderer(pyrender_scene(meshes), SIZE_PX) as first:
            before, _ = first.render(camera, pose)
            assert not current_context()
            with PyrenderRenderer(pyrender_scene(meshes[:1]), (33, 20)) as second:
                second.render(camera, pose)
            np.testing.assert_array_equal(own.render(pose)[0], alone)
            np.testing.assert_array_equal(first.render(camera, pose)[0], before)
        # `pyrender.OffscreenRenderer.delete` makes this picture wrong.
        np.testing.assert_array_equal(own.render(pose)[0], alone)
        assert not current_context()


def test_a_scene_can_be_rendered_again_and_keeps_its_camera():
    scene = pyrender_scene(three_meshes())
    main = scene.add(CAMERAS["finite"], pose=look_at((0.3, 0.4, 2.0), (0.0, 0.0, 0.0)))
    (first,) = pyrender_frames(scene, SIZE_PX)
    (again,) = pyrender_frames(scene, SIZE_PX)
    np.testing.assert_array_equal(first.color, again.color)
    assert scene.main_camera_node is main
    assert len(scene.camera_nodes) == 1
    assert (first.pupil_diameter_mm, first.focus_dpt) == (4.0, 0.0)
    other = CAMERAS["off_center"]
    (through_other,) = pyrender_frames(scene, SIZE_PX, camera=other)
    assert through_other.tangents == camera_tangents(other, SIZE_PX)


def test_the_scene_moves_while_the_path_goes_on():
    scene = pyrender.Scene()
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    node = scene.add(pyrender.Mesh.from_trimesh(box))

    def path():
        for distance_m in (1.0, 1.5, 2.0):
            scene.set_pose(node, translation_matrix((0.0, 0.0, -distance_m)))
            yield Moment(np.eye(4), State(3.0 + distance_m, 1.0 / distance_m))

    frames = pyrender_frames(scene, SIZE_PX, camera=CAMERAS["infinite"], path=path())
    found = [(f.depth_m.min(), f.pupil_diameter_mm, f.focus_dpt) for f in frames]
    expected = [(0.9, 4.0, 1.0), (1.4, 4.5, 1 / 1.5), (1.9, 5.0, 0.5)]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_two_eyes_see_a_near_thing_in_two_directions():
    card = trimesh.creation.box((0.3, 0.3, 1e-4))
    card.apply_transform(rotation_matrix(0.2, (0.0, 0.0, 1.0)))
    card.apply_translation((0.0, 0.0, -1.0))
    path = [Moment(np.eye(4), State(4.0, 1.0))]
    (frame,) = pyrender_frames(
        pyrender_scene([card]),
        SIZE_PX,
        camera=CAMERAS["infinite"],
        path=path,
        ipd_mm=63.0,
        supersampling=4,
    )
    left, right = frame.views
    assert frame.view.depth_m is left.depth_m
    pitch = (left.tangents[1] - left.tangents[0]) / SIZE_PX[0]
    columns = [np.nonzero(np.isfinite(v.depth_m))[1].mean() for v in (left, right)]
    assert (columns[0] - columns[1]) * pitch == pytest.approx(0.063, abs=1e-3)


def test_shadows_are_cast_with_a_numpy_without_infty():
    floor = trimesh.creation.box((4.0, 0.02, 4.0))
    plate = trimesh.creation.box((0.6, 0.02, 0.6))
    plate.apply_translation((0.0, 0.5, 0.0))
    scene = pyrender_scene([floor, plate])
    sun = pyrender.DirectionalLight(color=np.ones(3), intensity=3.0)
    scene.add(sun, pose=look_at((1.5, 2.0, 0.01), (0.0, 0.0, 0.0)))
    pose = look_at((0.0, 1.5, 2.5), (0.0, 0.0, 0.0))
    shadows = pyrender.RenderFlags.SHADOWS_DIRECTIONAL
    plain, _ = rendered(scene, CAMERAS["finite"], pose)
    shaded, _ = rendered(scene, CAMERAS["finite"], pose, flags=shadows)
    darker = plain.mean(axis=-1) - shaded.mean(axis=-1) > 10
    assert 0.003 < darker.mean() < 0.3


@pytest.mark.parametrize(
    ("camera", "pose", "says"),
    [
        (pyrender.OrthographicCamera(1.0, 1.0), np.eye(4), "OrthographicCamera"),
        (pyrender.PerspectiveCamera(1.0, znear=0.0), np.eye(4), r"znear.* is 0"),
        (CAMERAS["finite"], np.diag([2.0, 2.0, 2.0, 1.0]), "not rigid"),
    ],
)
def test_a_view_without_perspective_is_refused(camera, pose, says):
    scene = pyrender_scene(three_meshes()[:1])
    with pytest.raises(ValueError, match=says):
        rendered(scene, camera, pose)
    assert not scene.camera_nodes


def test_a_scene_without_a_camera_and_sizes_out_of_range_are_refused():
    scene = pyrender.Scene()
    with pytest.raises(ValueError, match="no camera"):
        next(pyrender_frames(scene, SIZE_PX))
    for size_px in ((0, 90), (200_000, 90)):
        with pytest.raises(ValueError, match=f"{size_px[0]}x90"):
            PyrenderRenderer(scene, size_px)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The three meshes as a file of each kind."""
    folder = tmp_path_factory.mktemp("files")
    scene = trimesh.Scene(three_meshes())
    scene.export(folder / "three.glb")
    joined = trimesh.util.concatenate(
        [trimesh.Trimesh(m.vertices, m.faces) for m in three_meshes()]
    )
    for kind in ("obj", "ply", "stl"):
        joined.export(folder / f"three.{kind}")
    return folder


@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "stl"])
def test_a_file_is_seen_whole_and_lit_from_all_around(files, kind):
    scene, bounds_m = load_file(files / f"three.{kind}")
    truth_m = trimesh.util.concatenate(three_meshes()).bounds
    np.testing.assert_allclose(bounds_m, truth_m, atol=1e-5)
    camera, moments = orbit(bounds_m, 4, SIZE_PX)
    frames = list(pyrender_frames(scene, SIZE_PX, camera=camera, path=moments))
    center_m = truth_m.mean(axis=0)
    for frame, moment in zip(frames, moments, strict=True):
        seen = np.isfinite(frame.depth_m)
        edge = np.concatenate([seen[[0, -1]].ravel(), seen[:, [0, -1]].ravel()])
        assert not edge.any()
        assert seen.mean() > 0.02
        distance_m = np.linalg.norm(moment.pose[:3, 3] - center_m)
        assert abs(np.median(frame.depth_m[seen]) - distance_m) < 0.9
        assert frame.color[seen].mean() > 40  # lit
        assert 3.0 <= moment.pupil_diameter_mm <= 5.0
    foci_dpt = [moment.focus_dpt for moment in moments]
    assert foci_dpt[0] > 1.2 * foci_dpt[2]


def test_a_textured_glb_keeps_its_colors(files):
    scene, _ = load_file(files / "three.glb")
    pose = look_at((0.65, 0.05, 1.2), (0.65, 0.05, 0.0))
    color, depth_m = rendered(scene, CAMERAS["infinite"], pose, flags=FLAT)
    seen = np.isfinite(depth_m)
    rows, columns = np.nonzero(seen & (np.abs(np.arange(160) - 80) < 20)[None])
    red, green = (color[rows, columns, k].astype(float) for k in (0, 1))
    assert np.corrcoef(columns, red)[0, 1] > 0.95
    assert abs(np.corrcoef(rows, green)[0, 1]) > 0.9


def test_millimeters_become_meters(files):
    _, bounds_m = load_file(files / "three.stl", m_per_unit=0.001)
    _, in_units = load_file(files / "three.stl")
    np.testing.assert_allclose(bounds_m, in_units / 1000.0)
    camera, (moment,) = orbit(bounds_m, 1, SIZE_PX)
    distance_m = np.linalg.norm(moment.pose[:3, 3] - bounds_m.mean(axis=0))
    assert distance_m >= 0.25
    assert camera.znear < 0.25


@pytest.mark.parametrize(
    ("name", "content", "m_per_unit", "says"),
    [
        ("none.glb", None, 1.0, "does not exist"),
        ("text.glb", b"hello", 1.0, "cannot be read"),
        ("kind.xyzzy", b"hello", 1.0, "cannot be read"),
        ("points.ply", "points", 1.0, "no triangles"),
        ("large.stl", "box", 1e5, "across"),
        ("unit.stl", "box", 0.0, "m_per_unit is 0"),
        ("unit.stl", "box", np.nan, "m_per_unit is nan"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, name, content, m_per_unit, says):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "points":
        trimesh.PointCloud(np.eye(3)).export(path)
    elif content == "box":
        trimesh.creation.box((1.0, 1.0, 1.0)).export(path)
    with pytest.raises((InvalidFile, ValueError), match=says) as caught:
        load_file(path, m_per_unit=m_per_unit)
    assert "\n" not in str(caught.value)


def test_a_file_that_places_one_mesh_too_often_is_refused(tmp_path):
    path = tmp_path / "many.gltf"
    trimesh.Scene(trimesh.creation.box((1.0, 1.0, 1.0))).export(path)
    header = json.loads(path.read_text())
    (mesh,) = (n["mesh"] for n in header["nodes"] if "mesh" in n)
    header["nodes"] = [{"mesh": mesh} for _ in range(MAX_PARTS + 1)]
    header["scenes"] = [{"nodes": list(range(MAX_PARTS + 1))}]
    path.write_text(json.dumps(header))
    with pytest.raises(InvalidFile, match=r"15,001 parts.*at most 15,000"):
        load_file(path)


@pytest.mark.parametrize("name", ["infinite", "off_center"])
def test_frames_come_back_filtered_through_the_service(real_service, name):
    scene = pyrender_scene(three_meshes())
    camera = CAMERAS[name]
    path = [
        Moment(look_at((x_m, 0.3, 2.0), (0.0, 0.0, 0.0)), State(pupil_mm, 0.5))
        for x_m, pupil_mm in ((0.0, 3.0), (0.2, 4.0), (0.4, 5.0))
    ]
    frames = list(pyrender_frames(scene, SIZE_PX, camera=camera, path=path, flags=FLAT))
    with FilterClient(real_service.endpoint) as client:
        client.set_profile("myopia", settings=EYES, views=[frames[0].view])
        answers = list(filter_in_order(client, iter(frames), FrameLog()))
    assert [a.pupil_diameter_mm for a in answers] == [3.0, 4.0, 5.0]
    for frame, answer in zip(frames, answers, strict=True):
        assert answer.color.shape == frame.color.shape
        sharp = np.abs(np.diff(frame.color.astype(float), axis=1)).max()
        blurred = np.abs(np.diff(answer.color.astype(float), axis=1)).max()
        assert blurred < 0.8 * sharp
        mean = frame.color.mean(axis=(0, 1))
        np.testing.assert_allclose(answer.color.mean(axis=(0, 1)), mean, atol=4.0)


def run_program(*arguments):
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "clients.pyrender_stream", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )


@pytest.mark.parametrize(
    "more",
    [
        ("--stereo", "--right-profile", "emmetropia"),
        ("--natural", "--look-around", "5"),
    ],
)
def test_the_program_streams_a_file(real_service, files, more):
    finished = run_program(
        *("--endpoint", real_service.endpoint, "--file", str(files / "three.glb")),
        *("--size", "96x54", "--frames", "3", "--json", *more),
    )
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert report["sent"] == 3
    assert report["frames"] + sum(report["drops"].values()) == 3
    assert report["frames"] >= 1


@pytest.mark.parametrize(
    ("platform", "before", "says"),
    [
        ("glx", "", r"PYOPENGL_PLATFORM is 'glx'; allowed: egl, osmesa"),
        (None, "import OpenGL.GL", "imported before PYOPENGL_PLATFORM was set"),
    ],
)
def test_another_opengl_platform_is_refused_in_one_line(platform, before, says):
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    if platform is not None:
        environment["PYOPENGL_PLATFORM"] = platform
    code = f"{before}\nfrom clients.pyrender_stream import main; main()"
    words = ("--renderer", "pyrender", "--endpoint", "tcp://127.0.0.1:9")
    finished = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert finished.returncode == 1
    assert finished.stderr.count("\n") == 1, finished.stderr
    assert re.search(says, finished.stderr)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--file", "a.glb", "--renderer", "own"), "--renderer is own"),
        (("--renderer", "pyrender", "--hidden"), "--hidden requires"),
        (("--file", "none.glb"), "'none.glb': does not exist"),
        (("--stereo", "--ipd-mm", "0"), "--ipd-mm is 0"),
        (("--right-profile", "myopia"), "--right-profile requires --stereo"),
    ],
)
def test_options_that_do_not_fit_are_refused_before_a_connection(arguments, says):
    finished = run_program("--endpoint", "tcp://127.0.0.1:9", *arguments)
    assert finished.returncode == 2
    assert says in finished.stderr
    assert finished.stderr.count("\n") == 1


def test_the_program_streams_a_built_in_scene_through_pyrender(real_service):
    finished = run_program(
        *("--endpoint", real_service.endpoint, "--scene", "primitives", "--json"),
        *("--renderer", "pyrender", "--size", "96x54", "--frames", "2"),
    )
    assert finished.returncode == 0, finished.stderr
    assert json.loads(finished.stdout)["sent"] == 2
