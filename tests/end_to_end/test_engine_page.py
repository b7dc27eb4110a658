"""The page for programs with engines: its formulas, its session and its figures."""

import itertools
import json
import re

import msgpack
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from clients.headset.runtime import angles_of, direction_of
from clients.scenes.scene_view import projection
from estimator.profiles import parse_profile
from filter_service import Camera
from filter_service.errors import BadMessage
from filter_service.messages import (
    Accepted,
    Hello,
    Ready,
    decode_request,
)
from tests.source_tree import ROOT

FOLDER = ROOT / "clients"
PAGE = (ROOT / "docs/how-to/game-engine.md").read_text(encoding="utf-8")
PROFILE = {"kind": "double", "mark": 5}
NEAR_M, FAR_M = 0.1, 300.0
LEFT_EYE = (-1.28, 0.9, 0.93, -1.33)
RIGHT_EYE = (-0.9, 1.28, 0.93, -1.33)
WIDE = (-0.5, 0.5, 0.3, -0.3)
SIZE_PX = (8, 6)


def fenced(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def printed():
    names = {}
    exec("\n".join(fenced("python")), names)
    return names


def off_center(edges, *, near, far, ahead, ndc):
    """A projection for columns; `ndc` is what the near and the far plane become."""
    left, right, up, down = edges
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 2.0 / (right - left)
    matrix[1, 1] = 2.0 / (up - down)
    matrix[0, 2] = -ahead * (right + left) / (right - left)
    matrix[1, 2] = -ahead * (up + down) / (up - down)
    matrix[3, 2] = ahead
    # z_ndc = a + b / D, with a and b from the two planes
    at_near, at_far = ndc
    b = (at_near - at_far) / (1.0 / near - 1.0 / far)
    matrix[2, 3] = b
    matrix[2, 2] = ahead * (at_far - b / far)
    return matrix


CONVENTIONS = {
    # name: ahead, ndc of near and far plane, z_ndc_min, far, meters a unit
    "OpenGL": (-1.0, (-1.0, 1.0), -1.0, FAR_M, 1.0),
    "Unity, Direct3D, Vulkan, Metal": (-1.0, (1.0, 0.0), 0.0, FAR_M, 1.0),
    "Direct3D, conventional": (1.0, (0.0, 1.0), 0.0, FAR_M, 1.0),
    "Unreal": (1.0, (1.0, 0.0), 0.0, np.inf, 0.01),
    "Godot": (-1.0, (1.0, 0.0), 0.0, FAR_M, 1.0),
    "Godot, Compatibility": (-1.0, (1.0, -1.0), -1.0, FAR_M, 1.0),
}
BY_CONVENTION = pytest.mark.parametrize(
    ("ahead", "ndc", "begin", "far_m", "unit_m"),
    CONVENTIONS.values(),
    ids=CONVENTIONS.keys(),
)


@pytest.fixture
def points_m():
    """Points before a camera, x and y by its tangents, then their depth."""
    rng = np.random.default_rng(3)
    depths_m = np.geomspace(NEAR_M, FAR_M, 40)
    return np.c_[rng.uniform(-1.0, 1.0, (40, 2)) * depths_m[:, None], depths_m]


def buffer_of(points_m, matrix, *, ahead, begin, unit_m):
    """What a depth buffer has at these points, by projecting them."""
    x, y, depth = points_m.T / unit_m
    clip = matrix @ np.stack([x, y, ahead * depth, np.ones_like(x)])
    assert_allclose(clip[3], depth)
    return (clip[2] / clip[3] - begin) / (1.0 - begin)


@BY_CONVENTION
@pytest.mark.parametrize("edges", [WIDE, LEFT_EYE, RIGHT_EYE])
def test_meters_come_back_from_any_depth_buffer(
    points_m, edges, ahead, ndc, begin, far_m, unit_m
):
    planes = {"near": NEAR_M / unit_m, "far": far_m / unit_m}
    matrix = off_center(edges, **planes, ahead=ahead, ndc=ndc)
    buffer = buffer_of(points_m, matrix, ahead=ahead, begin=begin, unit_m=unit_m)
    assert buffer.min() > -1e-12
    assert buffer.max() < 1.0 + 1e-12
    names = printed()
    found_m = names["depth_m"](buffer, matrix, begin, unit_m)
    assert_allclose(found_m, points_m[:, 2], rtol=1e-9)
    n, f = planes["near"], planes["far"]
    if np.isinf(f):
        by_name = names["depth_infinite_m"](buffer, n)
    elif ndc[0] > ndc[1]:
        by_name = names["depth_reversed_m"](buffer, n, f)
    else:
        by_name = names["depth_conventional_m"](buffer, n, f)
    assert_allclose(unit_m * by_name, points_m[:, 2], rtol=1e-9)


def test_unitys_shader_function_is_the_pages_formula():
    """`LinearEyeDepth` with `_ZBufferParams` as Unity's shaders define them."""
    d, ratio = np.linspace(0.0, 1.0, 33), FAR_M / NEAR_M
    names = printed()
    for x, y, formula in (
        (ratio - 1.0, 1.0, names["depth_reversed_m"]),
        (1.0 - ratio, ratio, names["depth_conventional_m"]),
    ):
        eye_m = 1.0 / (x / FAR_M * d + y / FAR_M)
        assert_allclose(formula(d, NEAR_M, FAR_M), eye_m)


def test_diopters_are_linear_in_the_buffer_and_16_bits_are_enough():
    d = np.linspace(0.0, 1.0, 2**16)
    names = printed()
    for formula in (names["depth_reversed_m"], names["depth_conventional_m"]):
        steps_dpt = np.diff(1.0 / formula(d, NEAR_M, FAR_M))
        assert_allclose(np.abs(steps_dpt), 0.00015, atol=5e-6)


def test_the_sky_is_infinite_where_the_far_plane_is():
    names = printed()
    matrix = off_center(WIDE, near=10.0, far=np.inf, ahead=1.0, ndc=(1.0, 0.0))
    sky = np.zeros(2, np.float32)
    assert_array_equal(names["depth_m"](sky, matrix, 0.0, 0.01), np.inf)
    assert_array_equal(names["depth_infinite_m"](sky, 10.0), np.inf)
    assert names["depth_reversed_m"](0.0, NEAR_M, FAR_M) == pytest.approx(FAR_M)
    assert names["depth_conventional_m"](1.0, NEAR_M, FAR_M) == pytest.approx(FAR_M)


@BY_CONVENTION
@pytest.mark.parametrize("edges", [WIDE, LEFT_EYE, RIGHT_EYE])
@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_tangents_come_back_from_any_projection(
    edges, turn, ahead, ndc, begin, far_m, unit_m
):
    matrix = off_center(edges, near=NEAR_M, far=far_m, ahead=ahead, ndc=ndc)
    matrix[1] *= turn  # a picture turned upside-down
    assert_allclose(printed()["tangents"](matrix), edges)
    if turn > 0:
        p00, p02 = matrix[0, 0], -ahead * matrix[0, 2]
        p11, p12 = matrix[1, 1], -ahead * matrix[1, 2]
        for formula, edge in zip(
            (
                "(P02 - 1) / P00",
                "(P02 + 1) / P00",
                "(P12 + 1) / P11",
                "(P12 - 1) / P11",
            ),
            edges,
            strict=True,
        ):
            assert f"= {formula}`" in PAGE
            found = eval(formula, {"P00": p00, "P02": p02, "P11": p11, "P12": p12})
            assert found == pytest.approx(edge)


def test_the_matrices_are_those_that_programs_have():
    """OpenGL's as our headset program has it; Unreal's, for rows, from its source."""
    ours = off_center(LEFT_EYE, near=NEAR_M, far=FAR_M, ahead=-1.0, ndc=(-1.0, 1.0))
    assert_allclose(ours, projection(LEFT_EYE, NEAR_M, FAR_M))
    left, right, up, down = LEFT_EYE
    width, height = right - left, up - down
    for_rows = np.array(
        [
            [2.0 / width, 0.0, 0.0, 0.0],
            [0.0, 2.0 / height, 0.0, 0.0],
            [-(right + left) / width, -(up + down) / height, 0.0, 1.0],
            [0.0, 0.0, 10.0, 0.0],
        ]
    )
    unreal = off_center(LEFT_EYE, near=10.0, far=np.inf, ahead=1.0, ndc=(1.0, 0.0))
    assert_allclose(for_rows.T, unreal)
    for name, place in (("P02", (2, 0)), ("P32", (2, 3)), ("P23", (3, 2))):
        row, column = place
        assert re.search(rf"`M\[{row}\]\[{column}\]` is {name}", PAGE)
        assert for_rows[place] == unreal[int(name[1]), int(name[2])]


def test_gaze_is_in_the_angles_of_a_frame():
    gaze_deg = printed()["gaze_deg"]
    for h_deg, v_deg in itertools.product((-30.0, 0.0, 12.5), (-20.0, 0.0, 15.0)):
        point = 3.0 * direction_of(h_deg, v_deg)
        assert_allclose(gaze_deg(*point), (h_deg, v_deg), atol=1e-9)
        assert_allclose(gaze_deg(*point), angles_of(point), atol=1e-9)


def test_a_degree_of_vergence_is_as_many_diopters_as_the_page_says():
    said_dpt, apart_mm = map(
        float,
        re.search(r"([\d.]+) dpt for\s+each\s+degree\s[^.]*?(\d+) mm", PAGE).groups(),
    )
    assert round(np.radians(1.0) / (apart_mm / 1000.0), 2) == said_dpt


# The session


def headers():
    profile, frame = map(json.loads, fenced("json"))
    return profile, frame


def scaled(header):
    """Make a printed header's images small: everything else stays."""
    for view in header["views"]:
        view["width_px"], view["height_px"] = SIZE_PX
    return header


def parts_of(frame):
    """Return images for a frame's header, as the page sizes them."""
    width_px, height_px = SIZE_PX
    parts = []
    for value in (10, 20)[: len(frame["views"])]:
        parts.append(np.full((height_px, width_px, 3), value, np.uint8).tobytes())
        parts.append(np.full((height_px, width_px), 2.0, np.float32).tobytes())
    return parts


def test_the_parts_have_the_sizes_that_the_page_says():
    _, frame = headers()
    sizes = [int(n) for n in re.findall(r"^\| [1-4] \|.*\| (\d+) \|$", PAGE, re.M)]
    expected = []
    for view in frame["views"]:
        pixels = view["width_px"] * view["height_px"]
        expected += [3 * pixels, 4 * pixels]
    assert sizes == expected
    assert f"two parts of {expected[0]} bytes" in PAGE
    assert round(sum(expected) / 1e6) == 49
    assert round(sum(expected[1::2]) / 2e6) == 14
    assert len(msgpack.packb(frame)) <= 4096


def test_the_printed_headers_are_what_the_service_reads():
    profile, frame = headers()
    request = decode_request([msgpack.packb(profile), json.dumps(PROFILE).encode()])
    assert request.eye == "left"
    assert request.views[0] == Camera(1832, 1920, LEFT_EYE)
    assert request.settings.gaze_range_deg == (15.0, 10.0)
    frame = scaled(frame)
    parts = parts_of(frame)
    decoded = decode_request([msgpack.packb(frame), *parts])
    assert decoded.display_time_ns == frame["display_time_ns"]
    for view, said, eye, edges in zip(
        decoded.views,
        frame["views"],
        ("left", "right"),
        (LEFT_EYE, RIGHT_EYE),
        strict=True,
    ):
        assert (view.eye, view.tangents) == (eye, edges)
        assert list(view.pose) == said["pose"]
        assert list(view.gaze_deg) == said["gaze_deg"]
    assert [images.color[0, 0, 0] for images in decoded.images] == [10, 20]
    assert [images.depth_m[0, 0] for images in decoded.images] == [2.0, 2.0]
    for wrong in (parts[:3], [*parts, b""], [parts[0][:-1], *parts[1:]]):
        with pytest.raises(BadMessage):
            decode_request([msgpack.packb(frame), *wrong])


def test_the_session_of_the_page_goes_as_it_says(shared_service, raw_client):
    profile, frame = map(scaled, headers())
    raw = raw_client(shared_service)
    hello = re.search(r"Send \*\*hello\*\*: `(\{.*?\})`", PAGE)[1]
    raw.send([msgpack.packb(json.loads(hello))])
    assert raw.receive().session_key
    for i, (eye, view) in enumerate(
        zip(("left", "right"), frame["views"], strict=True)
    ):
        camera = {k: view[k] for k in ("width_px", "height_px", "tangents")}
        header = profile | {"profile_id": i, "eye": eye, "views": [camera]}
        raw.send(
            [msgpack.packb(header), json.dumps(PROFILE | {"mark": 5 + i}).encode()]
        )
        replies = [raw.receive(), raw.receive()]
        assert isinstance(replies[0], Accepted)
        assert isinstance(replies[1], Ready)
    raw.send([msgpack.packb(frame), *parts_of(frame)])
    result = raw.receive()
    assert result.frame_id == frame["frame_id"]
    assert result.display_time_ns == frame["display_time_ns"]
    for view, said in zip(result.views, frame["views"], strict=True):
        assert (view.eye, list(view.pose)) == (said["eye"], said["pose"])
        assert list(view.gaze_deg) == said["gaze_deg"]
    colors = result.colors
    assert [int(color[0, 0, 0]) for color in colors] == [5, 6]
    assert [int(color[-1, -1, -1]) for color in colors] == [245, 235]


def test_the_eye_that_is_shown_is_accepted():
    (body,) = re.findall(r"`(\{\"kind\".*?\})`", PAGE)
    parse_profile(json.loads(body))


def test_hello_reads_as_printed():
    hello = re.search(r"Send \*\*hello\*\*: `(\{.*?\})`", PAGE)[1]
    assert decode_request([msgpack.packb(json.loads(hello))]) == Hello("my engine")


# What it says of files


def test_the_table_of_the_javascript_client_has_all_its_functions():
    source = (FOLDER / "js" / "filter_client.js").read_text(encoding="utf-8")
    methods = re.findall(r"^  (?:async )?(\w+)\(.*\{$", source, re.MULTILINE)
    functions = re.findall(r"^function (\w+)", source, re.MULTILINE)
    named = set(re.findall(r"`(\w+)`", PAGE))
    assert {"constructor", "filter", "begin"} <= set(methods)
    assert not {*methods, *functions} - named - {"for", "if", "catch"}
    lines = int(re.search(r"filter_client.js` \((\d+) lines", PAGE)[1])
    assert abs(source.count("\n") - lines) < 30


def test_the_gpus_times_are_those_of_the_benchmarks_page():
    low_ms, high_ms = re.search(
        r"([\d.]+) to ([\d.]+) ms\s+on\s+an\s+H200", PAGE
    ).groups()
    page = (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8")
    stereo_ms = [
        float(figure)
        for row in re.findall(r"^\| .* passes .* ms .*\|$", page, re.MULTILINE)
        for figure in re.findall(r"([\d.]+) ms", "|".join(row.split("|")[5:]))
    ]
    assert [float(low_ms), float(high_ms)] == [min(stereo_ms), max(stereo_ms)]
    slow_hz, fast_hz = re.search(
        r"is (\d+) to (\d+)\s+frames per second", PAGE
    ).groups()
    assert [int(slow_hz), int(fast_hz)] == [
        int(1000 / float(high_ms)),
        int(1000 / float(low_ms)),
    ]


def test_the_budget_has_the_gpus_figures():
    content = json.loads((ROOT / "tests/benchmarks/results/gpu.json").read_text())
    rows = {
        (row["method"].strip(), row["case"]): row["median_ms"]
        for row in content["rows"]
        if row["setting"] == "2 x 1832x1920 moving"
    }
    eyes = {case for _, case in rows}
    assert len(eyes) == 3

    def of(name):
        return [rows[name, eye] for eye in eyes]

    for start, found in (
        ("filter: upload to the GPU", of("upload")),
        ("filter: plan kernels on the CPU", of("psf_plan")),
        ("filter: passes", of("passes")),
        ("filter: total, including download", of("frame")),
    ):
        low, high = re.search(rf"\| {start} \| ([\d.]+) to ([\d.]+)", PAGE).groups()
        assert [float(low), float(high)] == [round(min(found), 1), round(max(found), 1)]


def test_the_commands_that_it_shows_belong_together():
    commands = re.findall(r"^    ocufilter (.*)$", PAGE, re.MULTILINE)
    shown = {command.split()[0]: command.split()[1:] for command in commands}
    assert set(shown) == {"serve", "status", "latency", "layer"}
    assert shown["serve"] == ["--bind", *shown["status"]]
    endpoint, *options = shown["latency"]
    assert [endpoint] == shown["status"]
    frame = headers()[1]["views"][0]
    assert "--stereo" in options
    size = options[options.index("--size") + 1]
    assert size == f"{frame['width_px']}x{frame['height_px']}"


def test_files_that_the_page_names_exist():
    named = re.findall(r"`((?:clients|tests|filter_service)/[\w./]+)`", PAGE)
    assert len(named) > 5
    assert not [name for name in named if not (ROOT / name).exists()]
