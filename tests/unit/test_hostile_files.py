"""Hostile files: refused by one exception, before they cost memory or time."""

import pickle
import struct
import time
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from clients.batch.datasets import KinectCounts, read_calibration, tum_frames
from clients.batch.manifest import Manifest, below, records_of, write_whole
from clients.batch.source import read_states
from clients.commands.options import display_of_file, read_object
from clients.headset.gltf_scene import load_gltf
from estimator.bounded_files import (
    InvalidFile,
    loads_bounded,
    read_json,
    read_text,
    read_toml,
)
from estimator.eye.checked_fields import ProfileError
from estimator.profiles.files import load_profile
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.bounded_images import MAX_PIXELS
from filter_service.building import from_profile
from filter_service.building.jobs import BuildJob
from filter_service.camera import Camera
from filter_service.errors import BuildFailed, GridTooLarge
from filter_service.image_files import read_color, read_depth
from filter_service.planning.defocus_nodes import _spread
from filter_service.planning.plan import plan_cache
from filter_service.settings import FilterSettings
from tests.grid_specs import grid_spec
from tests.unit.gltf_bytes import glb, triangle_bytes, triangle_header


def refused(read, path, said=None):
    """Read a file that must be refused in two seconds of work; return the error."""
    start_s = time.process_time()
    with pytest.raises(InvalidFile, match=said) as caught:
        read(path)
    assert time.process_time() - start_s < 2.0
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    return caught.value


def png(width, height, *, extra=b""):
    """Return a PNG with a valid header and few pixels."""

    def chunk(kind, data):
        end = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + end

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(100))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + extra
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
    )


# ----- pictures


def test_a_png_of_169_megapixels_is_refused_by_its_header(tmp_path):
    path = tmp_path / "large.png"
    path.write_bytes(png(13000, 13000))
    error = refused(read_color, path, "13000x13000 px")
    assert f"{MAX_PIXELS:,}" in error.allowed
    refused(lambda p: read_depth(p, depth_scale=1.0), path, "13000x13000 px")


@pytest.mark.parametrize("sides", [(2**31 - 1, 2**31 - 1), (0, 5), (65536, 65536)])
def test_sides_that_no_picture_has(tmp_path, sides):
    path = tmp_path / "a.png"
    path.write_bytes(png(*sides))
    refused(read_color, path)


def test_a_png_of_a_million_chunks(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(
        png(8, 8, extra=(struct.pack(">I", 0) + b"abCd" + bytes(4)) * 10**6)
    )
    refused(read_color, path, "chunks")


def test_a_text_chunk_that_unpacks_to_a_gigabyte(tmp_path):
    data = b"Comment\0\0" + zlib.compress(bytes(2**30 // 16), 9)
    chunk = struct.pack(">I", len(data)) + b"zTXt" + data
    chunk += struct.pack(">I", zlib.crc32(b"zTXt" + data))
    path = tmp_path / "a.png"
    path.write_bytes(png(8, 8, extra=chunk))
    refused(read_color, path, "cannot be read")


def test_a_truncated_picture(tmp_path, rng):
    whole = tmp_path / "whole.png"
    Image.fromarray(rng.integers(0, 256, (64, 64, 3), np.uint8)).save(whole)
    path = tmp_path / "cut.png"
    path.write_bytes(whole.read_bytes()[:500])
    refused(read_color, path, "cannot be read")


def test_another_format_under_a_known_name(tmp_path):
    path = tmp_path / "a.png"
    Image.new("RGB", (8, 8)).save(path, "GIF")
    refused(read_color, path, "unknown image format")


def test_a_jpeg_of_many_scans(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (2048, 2048)).save(path, progressive=True)
    content = path.read_bytes()
    path.write_bytes(content[:-2] + content[content.rindex(b"\xff\xda") :] * 300)
    refused(read_color, path, "scans")


def test_a_tiff_tag_of_many_values(tmp_path):
    path = tmp_path / "a.tif"
    entry = struct.pack("<HHLL", 273, 4, 2**30, 8)
    path.write_bytes(b"II*\0" + struct.pack("<LH", 8, 1) + entry + bytes(4))
    refused(read_depth, path, "tag 273")


def test_a_plain_pgm_that_would_take_a_minute(tmp_path):
    path = tmp_path / "a.pgm"
    path.write_bytes(b"P2 8000 8000 65535\n" + b"1 " * 1000)
    refused(read_depth, path, "samples")


# ----- .npy


def npy(header, data=b"", version=b"\1\0"):
    """Return a .npy file with a header as given."""
    width = "<H" if version[0] == 1 else "<I"
    head = header.encode()
    return b"\x93NUMPY" + version + struct.pack(width, len(head)) + head + data


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (100000, 100000, 3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4294967296, 4294967296), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 4), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f99', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f4', 'fortran_order': False, }",
        "{'descr': '<f4', 'fortran_order': 1, 'shape': (1,), }",
        "{" * 5000,
        "(" * 9000,
        "'",
        "{'descr': '\x00",
        "",
    ],
)
@pytest.mark.parametrize("version", [b"\1\0", b"\2\0", b"\3\0"])
def test_npy_headers_that_lie(tmp_path, header, version):
    path = tmp_path / "a.npy"
    path.write_bytes(npy(header, bytes(64), version))
    refused(read_color, path)
    refused(read_depth, path)


def test_a_npy_file_whose_shape_is_more_than_it_holds(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.ones((40, 60), np.float32))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"(40, 60)", b"(41, 60)"))
    refused(read_depth, path, r"shape \(41, 60\) of float32 in 9,600 bytes")


def test_a_sparse_npy_file_beyond_the_limit(tmp_path):
    path = tmp_path / "a.npy"
    path.write_bytes(
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (20000, 20000), }")
    )
    with path.open("r+b") as file:
        file.truncate(20000 * 20000 * 8 + 200)
    refused(read_depth, path, "3,200,000,000 bytes")


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f2", "<u2", ">i4", "|u1", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_files_come_back_as_numpy_reads_them(tmp_path, dtype, order):
    stored = np.arange(35).reshape(5, 7).astype(dtype, order=order)
    np.save(tmp_path / "a.npy", stored)
    expected = np.load(tmp_path / "a.npy") * np.float64(0.5)
    found = read_depth(tmp_path / "a.npy", depth_scale=0.5)
    np.testing.assert_array_equal(found, expected.astype(np.float32))


# ----- OpenEXR


def test_an_exr_of_rows_too_long_to_unpack_is_refused_by_its_header(tmp_path):
    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.DWAA_COMPRESSION}
    with OpenEXR.File(header, {"RGB": np.ones((8, 8, 3), np.float32)}) as file:
        file.write(str(path))
    read_color(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + 21
    content[at : at + 16] = struct.pack("<4i", 0, 0, 2**24 - 1, 0)
    path.write_bytes(content)
    refused(read_color, path, "201,326,592 bytes in a chunk")


@pytest.mark.parametrize("side", [20_000, 2**30])
def test_an_exr_of_a_large_window_is_refused_by_its_header(tmp_path, side, capfd):
    path = tmp_path / "a.exr"
    with OpenEXR.File(
        {"type": OpenEXR.scanlineimage}, {"Z": np.ones((8, 8), np.float32)}
    ) as file:
        file.write(str(path))
    content = bytearray(path.read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + 21
    content[at : at + 16] = struct.pack("<4i", 0, 0, side - 1, side - 1)
    path.write_bytes(content)
    refused(read_depth, path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["ZIP", "RLE", "PIZ", "NO"])
def test_an_exr_with_damaged_pixels_is_refused_without_a_word(
    tmp_path, rng, capfd, compression
):
    path = tmp_path / "a.exr"
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
    }
    with OpenEXR.File(header, {"Z": rng.random((64, 64), np.float32)}) as file:
        file.write(str(path))
    content = path.read_bytes()
    path.write_bytes(content[: 2 * len(content) // 3])
    refused(read_depth, path, "cannot be read")
    assert capfd.readouterr() == ("", "")


def test_a_tiff_with_damaged_pixels_is_refused_without_a_word(tmp_path, rng, capfd):
    path = tmp_path / "a.tif"
    meters = Image.fromarray(rng.random((64, 64), np.float32))
    meters.save(path, compression="tiff_deflate")
    content = bytearray(path.read_bytes())
    content[8:40] = bytes(32)
    path.write_bytes(content)
    refused(read_depth, path, "cannot be read")
    assert capfd.readouterr() == ("", "")


# ----- profiles and other text


DEEP = {
    "eye.json": '{"a":' * 100_000,
    "list.json": "[" * 1_000_000,
    "closed.json": '{"kind": ' + "[" * 40 + "]" * 40 + "}",
    "digits.json": '{"kind": "preset", "age_years": ' + "9" * 5000 + "}",
    "bits.json": '{"kind": "preset", "age_years": 99999999999999999999999}',
    "long.json": "[" + "1," * 1_500_000 + "1]",
    "half.json": '{"kind": "\\ud800"}',
    "five.json": "5",
    "eye.abp": "Z[2,0] = 1\n" * 30_000,
    "digits.abp": f"Z[{'9' * 5000},0] = 1\n",
    "eye.csv": f"{'9' * 5000},0,1\n",
    "sign.csv": "--2,0,1\n",
    "null.csv": "2,0,1\0\n",
    "huge.csv": "#" * 3_000_000,
}


@pytest.mark.parametrize("name", DEEP)
def test_profile_files_that_are_none(tmp_path, name):
    path = tmp_path / name
    path.write_text(DEEP[name])
    error = refused(load_profile, path)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_profile_with_a_wrong_field_names_file_and_field(tmp_path):
    path = tmp_path / "eye.json"
    path.write_text('{"kind": "preset", "name": "nobody"}')
    error = refused(load_profile, path, "name")
    assert error.field == "name"
    assert "myopia" in error.allowed


@pytest.mark.parametrize(
    "text",
    ["1,2\n" * 50, "nan,1,2,3\nnan,1,2,3\n", "1e308,1,2,3\n2e308,1,2,3", "", "\0"],
)
def test_display_files_that_hold_no_spectra(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text)
    refused(lambda p: display_of_file(str(p)), path)


@pytest.mark.parametrize("content", [b"\xff\xfe\0", b"\n" * 300_000, b"a\0b"])
def test_text_that_is_none(tmp_path, content):
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    refused(read_text, path)


def test_what_is_no_regular_file(tmp_path):
    path = tmp_path / "a.json"
    path.mkdir()
    refused(read_json, path, "not a regular file")
    refused(read_json, tmp_path / "absent.json", "no such file")


@pytest.mark.parametrize("text", ["a = [" * 5000, "a = 1\na = 2", "=", "a = '\0'"])
def test_toml_that_is_none(tmp_path, text):
    path = tmp_path / "a.toml"
    path.write_text(text)
    refused(read_toml, path)
    path.write_text("a = 1")
    assert read_toml(path) == {"a": 1}


def test_json_bounds():
    assert loads_bounded(b'\xef\xbb\xbf{"a": [1, 2.5]}', max_bytes=99) == {
        "a": [1, 2.5]
    }
    for text, said in (
        ('{"a": 1, "a": 2}', "twice"),
        ("[" * 33 + "]" * 33, "deep"),
        ("[1, 2, 3]", "3 values"),
        ("[99999999999999999999]", "bits"),
        ("[" + "9" * 5000 + "]", "digits"),
        ("[NaN]", "finite"),
        ("[1e999]", "finite"),
        ("9" * 100, "bytes"),
        ('["\\udc00"]', "surrogate"),
        ("\xff", "decode"),
    ):
        with pytest.raises(ValueError, match=said):
            loads_bounded(
                text.encode("latin-1"),
                max_bytes=8000 if "bytes" not in said else 99,
                max_items=3 if "values" in said else 100,
                finite=True,
            )
    assert loads_bounded(b"[" * 32 + b"]" * 32, max_bytes=99) is not None
    assert loads_bounded(b'["\\ud83d\\ude00"]', max_bytes=99) == ["\U0001f600"]


# ----- glTF


def textured(image):
    """Return changes of a header that give its triangle an image."""
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    texture = {"baseColorTexture": {"index": 0}}
    return {
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": texture}],
        "textures": [{"source": 0}],
        "images": [image],
    }


def nested(count):
    """Return nodes within each other."""
    return [{"mesh": 0, "children": [k + 1]} for k in range(count)] + [{"mesh": 0}]


def position(**fields):
    """Return accessors of which the first has other fields."""
    first, *rest = triangle_header()["accessors"]
    return {"accessors": [first | fields, *rest]}


GLTF = {
    "nested nodes": ({"nodes": nested(5000)}, "more than 1000 deep"),
    "a circle": ({"nodes": [{"children": [1]}, {"children": [0]}]}, "occurs twice"),
    "two parents": ({"nodes": [{"children": [1, 1]}, {}]}, "occurs twice"),
    "a child": ({"nodes": [{"children": [-1]}]}, "node -1"),
    "many nodes": (
        {"scenes": [{"nodes": list(range(40_000))}], "nodes": [{"mesh": 0}] * 40_000},
        "more than 15,000 parts",
    ),
    "a count": (position(count=2**31), "ends at byte 25,769,803,776"),
    "an end": (position(count=4), "ends at byte 48"),
    "an offset": (position(byteOffset=2**39), "ends at byte"),
    "zeros": (
        {"accessors": [{"componentType": 5126, "count": 2**33, "type": "VEC3"}] * 3},
        "triangles",
    ),
    "a type": (position(type="MAT4"), "type is 'MAT4'"),
    "a float": (position(count=3.0), "count is 3.0"),
    "a view": (
        {"bufferViews": [{"buffer": 0, "byteLength": 2**33}] * 3},
        "ends at byte 8,589,934,592",
    ),
    "a buffer": ({"buffers": []}, "'buffers' 0"),
    "a matrix": ({"nodes": [{"mesh": 0, "matrix": [1e308] * 16}]}, "no triangles"),
    "a scale": (
        {
            "nodes": [
                {"children": [1], "scale": [1e200] * 3},
                {"mesh": 0, "scale": [1e200] * 3},
            ]
        },
        "is not finite",
    ),
    "no list": ({"meshes": {"0": 1}}, "not a list"),
    "a huge image": (textured({"uri": "large.png"}), "13000x13000"),
    "http": (textured({"uri": "http://a.example/b.png"}), "a file in its folder"),
    "an absolute path": (textured({"uri": "/etc/passwd"}), "a file in its folder"),
    "another folder": (textured({"uri": "../secret.png"}), "leads out of its folder"),
    "coded": (textured({"uri": "%2e%2e/secret.png"}), "leads out of its folder"),
    "a link": (textured({"uri": "link.png"}), "leads out of its folder"),
    "absent": (textured({"uri": "absent.png"}), "no such file"),
    "a null byte": (textured({"uri": "a\0.png"}), "leads out of its folder"),
    "a URI": (textured({"uri": "data:image/png;base64,AAA"}), "not base64"),
}


@pytest.mark.parametrize("case", GLTF)
def test_gltf_files_that_are_refused(tmp_path, case):
    changes, said = GLTF[case]
    (tmp_path / "secret.png").write_bytes(png(8, 8))
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "large.png").write_bytes(png(13000, 13000))
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    path = folder / "a.glb"
    path.write_bytes(glb(triangle_header(**changes), triangle_bytes()))
    refused(load_gltf, path, said)


@pytest.mark.parametrize(
    "header",
    [
        b'{"asset": {"version": "2.0"}, "extras": ' + b'{"a":' * 100_000,
        b"[" * 1_000_000,
        b'{"asset": {"version": 2' + b"0" * 5000 + b"}}",
        b'{"asset": {"version": NaN}}',
        b"\xff",
    ],
)
def test_gltf_headers_that_are_refused(tmp_path, header):
    path = tmp_path / "a.glb"
    path.write_bytes(glb(header))
    refused(load_gltf, path, "not a glTF file")


def test_a_triangle_out_of_range_and_one_that_is_fine(tmp_path):
    path = tmp_path / "a.glb"
    data = bytearray(triangle_bytes())
    path.write_bytes(glb(triangle_header(), bytes(data)))
    scene = load_gltf(path)
    assert scene.n_triangles == 1
    np.testing.assert_array_equal(scene.batches[0].vertices_m[:, 2], -2.0)
    data[60] = 7
    path.write_bytes(glb(triangle_header(), bytes(data)))
    refused(load_gltf, path, "vertex 7")


def test_a_gltf_texture_beside_it_is_read(tmp_path):
    (tmp_path / "a b.png").write_bytes(b"")
    Image.new("RGB", (8, 8), (1, 2, 3)).save(tmp_path / "a b.png")
    header = triangle_header(**textured({"uri": "a%20b.png"}))
    path = tmp_path / "a.glb"
    path.write_bytes(glb(header, triangle_bytes()))
    assert tuple(load_gltf(path).batches[0].texture[0, 0]) == (1, 2, 3)


# ----- data sets


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1.0 /etc/passwd", "is outside the data set"),
        ("1.0 rgb/../../secret.png", "is outside the data set"),
        ("nan rgb/a.png", "not a time"),
        ("1e999 rgb/a.png", "not a time"),
        ("1.0", "1 fields"),
        ("1.0 a\0.png", "not a text file"),
        ("\n" * 300_000, "lines"),
    ],
)
def test_lists_of_frames_that_are_refused(tmp_path, line, said):
    (tmp_path / "depth.txt").write_text("1.0 depth/a.png\n")
    path = tmp_path / "rgb.txt"
    path.write_text(line + "\n")
    refused(lambda p: tum_frames(p.parent), path, said)


def test_a_list_of_thousands_of_times_within_a_moment_is_read_at_once(tmp_path):
    for name in ("rgb", "depth"):
        lines = [f"{k * 1e-7:.7f} {name}/{k}.png" for k in range(3000)]
        (tmp_path / f"{name}.txt").write_text("\n".join(lines))
    start_s = time.perf_counter()
    assert len(tum_frames(tmp_path)) == 3000
    assert time.perf_counter() - start_s < 5.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "'cam0' is missing"),
        ("cam0=[1.2.3 0 1; 0 1 1; 0 0 1]\ndoffs=0\nbaseline=1", "cam0 is"),
        ("cam0=[1e300 0 1; 0 1 1; 0 0 1]\ndoffs=0\nbaseline=1", "cam0 is"),
        ("cam0=[9 0 1; 0 9 1; 0 0 1]\ndoffs=nan\nbaseline=1", "not a number"),
        ("cam0=" + " 1" * 50_000, "bytes"),
    ],
)
def test_calibrations_that_are_refused(tmp_path, text, said):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    refused(read_calibration, path, said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "columns none"),
        ("frame,pupil_mm\n" + "x" * 200_000 + ",4", "not CSV"),
        ("frame,pupil_mm\na,nan", "pupil_mm 'nan'"),
        ("pupil_mm,frame\n4", "no frame"),
        ("frame,pupil_mm\n" + "9" * 5000 + ",400", "pupil_mm '400'"),
        ("frame\n" + "a\n" * 300_000, "lines"),
    ],
)
def test_lists_of_states_that_are_refused(tmp_path, text, said):
    path = tmp_path / "states.csv"
    path.write_text(text)
    refused(lambda p: read_states(p, ["000001"]), path, said)


def test_depth_that_a_kinect_does_not_count(tmp_path):
    path = tmp_path / "d-1.0-1.pgm"
    Image.fromarray(np.ones((48, 64), np.uint16)).save(path)
    refused(KinectCounts().read, path, "64x48")


@pytest.mark.parametrize(
    "content",
    [
        b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile:///etc/passwd\n",
        b"ffconcat version 1.0\nfile /etc/passwd\n",
        b"\x1a\x45\xdf\xa3" + b"\xff" * 100,
        b"",
    ],
)
def test_videos_that_are_none(tmp_path, content):
    video_reading = pytest.importorskip("clients.batch.video_reading")
    path = tmp_path / "a.mkv"
    path.write_bytes(content)
    refused(video_reading.VideoReader, path, "cannot be read")


def test_a_video_of_frames_that_are_too_large(tmp_path, monkeypatch):
    video_reading = pytest.importorskip("clients.batch.video_reading")
    from clients.batch.video_writing import VIDEO_KINDS, write_segment

    path = tmp_path / "a.mkv"
    frames = [(k, np.zeros((64, 64, 3), np.uint8)) for k in range(4)]
    write_segment(path, iter(frames), kind=VIDEO_KINDS["ffv1"], rate_hz=30.0)
    with video_reading.VideoReader(path) as reader:
        assert reader.count == 4
    monkeypatch.setattr(video_reading, "MAX_VIDEO_FRAMES", 3)
    refused(video_reading.VideoReader, path, "more than 3 frames")
    monkeypatch.setattr(video_reading, "MAX_VIDEO_PIXELS", 1000)
    refused(video_reading.VideoReader, path, "64x64 px")


# ----- what is written, and told of it


@pytest.mark.parametrize(
    "line",
    [
        b'{"kind": "frame"}',
        b'{"kind": "frame", "profile": [], "frame": "a", "ok": true}',
        b'{"kind": "frame", "profile": "p", "frame": "a", "ok": true, "file": 1}',
        b"[" * 100_000,
        b"5",
    ],
)
def test_manifests_that_are_refused(tmp_path, line):
    Manifest(tmp_path, {"made_by": "x"}).__exit__()
    path = tmp_path / "manifest.jsonl"
    path.write_bytes(path.read_bytes() + line + b"\n")
    refused(lambda p: Manifest(p.parent, {"made_by": "x"}), path)
    assert len(list(records_of(path))) <= 2


def test_a_manifest_names_no_file_outside_of_its_folder(tmp_path):
    out, secret = tmp_path / "out", tmp_path / "secret"
    out.mkdir()
    secret.mkdir()
    (out / "link").symlink_to(secret)
    for name in ("../secret/a", str(secret / "a"), "link/a", "a/../../b", "", 5, "\0"):
        assert below(out, name) is None
    assert below(out, "profile/a.png") == out / "profile/a.png"


def test_links_are_not_followed_where_files_are_written(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("kept")
    (tmp_path / "manifest.jsonl").symlink_to(victim)
    with pytest.raises(InvalidFile, match="cannot be opened"):
        Manifest(tmp_path, {})
    monkeypatch.setattr("secrets.token_hex", lambda n: "0")
    (tmp_path / ".ocufilter-0.part.txt").symlink_to(victim)
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "a.txt", lambda path: path.write_text("lost"))
    assert victim.read_text() == "kept"


def test_an_object_on_the_command_line_is_bounded():
    for text in ("[" * 100_000, '{"a":' * 100_000, '{"a": ' + "9" * 5000 + "}"):
        with pytest.raises(ValueError, match="--settings"):
            read_object("--settings", text)


# ----- eyes that are none


HOPELESS = {
    "kind": "zernike",
    "pupil_diameter_mm": 2,
    "wavelength_nm": 580.0,
    "zernike_um": {"2,0": -43, "4,-4": 0.04},
    "age_years": 3,
}


@pytest.mark.parametrize("zernike_um", [{"6,0": 100}, {"2,0": -48}, {"3,1": 90}])
def test_rays_that_cross_before_the_pupil_are_refused(zernike_um):
    with pytest.raises(ProfileError, match="rays cross between cornea and pupil"):
        parse_profile({**HOPELESS, "zernike_um": zernike_um})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("mode", ["on-axis", "dynamic"])
def test_an_eye_that_is_out_of_focus_as_none_is(mode):
    eye = MeasuredWavefront.from_profile(parse_profile(HOPELESS))
    camera = Camera(640, 480, (-0.5, 0.5, 0.4, -0.4))
    spec = grid_spec(camera, mode=mode, pupil_range_mm=(0.5, 0.5))
    with pytest.raises(ProfileError, match="out of focus by") as caught:
        plan_cache(eye, spec)
    assert caught.value.field == "profile"
    assert "1000 dpt" in caught.value.allowed


def spread(low_dpt, high_dpt, needed):
    """Nodes of one range."""
    return _spread(np.array([low_dpt]), np.array([high_dpt]), needed[None])[0]


def test_nodes_of_defocus_ascend_whatever_is_needed():
    flat = np.zeros(49)
    np.testing.assert_array_equal(spread(1.0, 2.0, flat), [1.0, 2.0])
    steep = np.linspace(0.0, 1e9, 49)
    with pytest.raises(GridTooLarge) as caught:
        spread(1.0, 2.0, steep)
    assert caught.value.field == "settings.object_range_dpt"
    with pytest.raises(GridTooLarge):
        spread(1.0, 2.0, steep * np.nan)
    close = spread(5e21, 5e21 + 2e6, np.linspace(0.0, 3.0, 49))
    assert (np.diff(close) > 0.0).all()


def test_what_a_computation_says_reaches_a_client_with_a_field(monkeypatch):
    def fail(*_, **__):
        raise ValueError("zero-size array to reduction operation minimum")

    monkeypatch.setattr(from_profile, "plan_axes", fail)
    job = BuildJob(
        parse_profile({"kind": "preset", "name": "myopia"}),
        FilterSettings(mode="on-axis", eye_model="wavefront"),
        Camera(64, 48, (-0.5, 0.5, 0.4, -0.4)),
    )
    with pytest.raises(BuildFailed) as caught:
        from_profile.build(job, progress=lambda *_: None, cancelled=lambda: False)
    assert caught.value.field == "settings"
    assert caught.value.allowed
