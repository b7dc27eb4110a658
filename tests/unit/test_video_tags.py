"""Tags of videos: orientation, pixel shape, color and times, as FFmpeg writes them."""

from contextlib import closing
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from clients.batch.layouts import list_frames
from clients.batch.source import FieldOfView, States
from clients.batch.work import Job, Unit, UnitRunner, batch_settings
from filter_service.image_files import read_color_file

av = pytest.importorskip("av")
reading = pytest.importorskip("clients.batch.video_reading")

WIDTH_PX, HEIGHT_PX = 48, 32
BT709, BT601, BT2020 = 1, 6, 9
PQ, HLG = 16, 18
WEIGHTS = {BT709: (0.2126, 0.0722), BT601: (0.299, 0.114), BT2020: (0.2627, 0.0593)}


@pytest.fixture
def picture(rng):
    """Return blocks of random colors, none of which repeat."""
    small = rng.integers(0, 256, (HEIGHT_PX // 8, WIDTH_PX // 8, 3), dtype=np.uint8)
    return np.kron(small, np.ones((8, 8, 1), np.uint8))


def write(
    path,
    frames,
    *,
    source="rgb24",
    codec="ffv1",
    pixels="bgr0",
    turned=None,
    aspect=None,
    times_s=None,
    rate_hz=10,
    **tags,
):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate_hz)
        is_planar = source.startswith("yuv420")
        height_px = len(frames[0]) * 2 // 3 if is_planar else len(frames[0])
        stream.width, stream.height = frames[0].shape[1], height_px
        stream.pix_fmt = pixels
        if turned is not None:
            stream.set_display_rotation(*turned)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if times_s is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for k, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format=source)
            for name, value in tags.items():
                setattr(frame, name, value)
            if times_s is not None:
                frame.pts, frame.time_base = round(1000 * times_s[k]), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def first_frame(path):
    with reading.VideoReader(path) as reader:
        return reader.color(0)


def yuv420(rgb, matrix, *, bits=8, full=False):
    """Return one color as planes, by the formulas of H.273."""
    red, blue = WEIGHTS[matrix]
    r, g, b = rgb
    y = red * r + (1.0 - red - blue) * g + blue * b
    u, v = (b - y) / (2.0 - 2.0 * blue), (r - y) / (2.0 - 2.0 * red)
    step = 1 << (bits - 8)
    if full:
        codes = [
            (256 * step - 1) * y,
            *((256 * step - 1) * c + 128 * step for c in (u, v)),
        ]
    else:
        codes = [step * (16 + 219 * y), *(step * (128 + 224 * c) for c in (u, v))]
    planes = np.empty((HEIGHT_PX * 3 // 2, WIDTH_PX), np.uint8 if bits == 8 else "<u2")
    planes[:HEIGHT_PX] = round(codes[0])
    planes[HEIGHT_PX : HEIGHT_PX * 5 // 4] = round(codes[1])
    planes[HEIGHT_PX * 5 // 4 :] = round(codes[2])
    return planes


# --- orientation -------------------------------------------------------------

TURNS = {
    # orientation of EXIF: rotation counterclockwise, and mirroring after it
    1: (0, False, False),
    2: (0, True, False),
    3: (180, False, False),
    4: (0, False, True),
    5: (90, False, True),
    6: (-90, False, False),
    7: (-90, False, True),
    8: (90, False, False),
}


@pytest.mark.parametrize("orientation", TURNS)
def test_a_video_and_a_photograph_with_an_orientation_are_the_same(
    tmp_path, picture, orientation
):
    write(
        tmp_path / "a.mov",
        [picture],
        codec="png",
        pixels="rgb24",
        turned=TURNS[orientation],
    )
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).save(tmp_path / "a.png", exif=exif)
    found = first_frame(tmp_path / "a.mov").pixels
    np.testing.assert_array_equal(found, read_color_file(tmp_path / "a.png").pixels)
    upright = first_frame(tmp_path / "a.mov").grid
    assert (upright.width_px, upright.height_px) == found.shape[1::-1]


def test_depth_in_a_video_is_turned_too(tmp_path, rng):
    depth = rng.integers(0, 65535, (HEIGHT_PX, WIDTH_PX)).astype(np.uint16)
    how = {"source": "gray16le", "pixels": "gray16le", "turned": (90,)}
    write(tmp_path / "a.mkv", [depth], **how)
    with reading.VideoReader(tmp_path / "a.mkv") as reader:
        np.testing.assert_array_equal(reader.integers(0), np.rot90(depth))


def test_a_rotation_by_45_degrees_is_refused(tmp_path, picture):
    write(tmp_path / "a.mov", [picture], codec="png", pixels="rgb24", turned=(45,))
    with pytest.raises(ValueError, match=r"a\.mov.*allowed: multiples of 90"):
        first_frame(tmp_path / "a.mov")


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    """Return a runner whose astigmatic eye is built, and its folder of results."""
    states = States(5.0, 0.0)
    mode = {
        **{"mode": "on-axis", "eye_model": "wavefront", "object_range_dpt": [0.5, 0.5]},
        **{"pupil_range_mm": [5.0, 5.0], "focus_range_dpt": [0.0, 0.0]},
    }
    body = {"kind": "prescription", "sphere_dpt": 0, "cylinder_dpt": -3, "axis_deg": 20}
    job = Job({"eye": body}, batch_settings(mode, states), states, "npy")
    out, folder = tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("first")
    np.save(folder / "a_depth.npy", np.full((HEIGHT_PX, WIDTH_PX), 2.0, np.float32))
    Image.new("RGB", (WIDTH_PX, HEIGHT_PX)).save(folder / "a_color.png")
    _, frames = list_frames(folder, "pairs", optics=FieldOfView(5.0))
    with closing(UnitRunner(job, out)) as running:
        assert [record["ok"] for record in running.run(Unit(0, "eye", tuple(frames)))]
        yield running, out


def test_an_astigmatic_eye_sees_the_same_in_a_turned_video_and_in_photographs(
    tmp_path, picture, runner
):
    """A picture taken sideways, as a video and as a photograph, and the upright one."""
    running, out = runner
    sideways = np.rot90(picture).copy()  # to be turned clockwise
    for name in ("color", "depth"):
        (tmp_path / name).mkdir()
    write(tmp_path / "a.mov", [sideways], codec="png", pixels="rgb24", turned=(-90,))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(sideways).save(tmp_path / "color/photo.png", exif=exif)
    Image.fromarray(picture).save(tmp_path / "color/upright.png")
    depth_m = np.full(picture.shape[:2], 2.0, np.float32)
    for name in ("photo", "upright"):
        np.save(tmp_path / f"depth/{name}.npy", depth_m)
    (tmp_path / "video").mkdir()
    np.save(tmp_path / "video/0.npy", depth_m)
    optics = FieldOfView(5.0)
    _, photos = list_frames(tmp_path, "auto", optics=optics)
    given = tmp_path / "video", optics
    _, video = list_frames(tmp_path / "a.mov", "auto", *given)
    records = list(running.run(Unit(0, "eye", (*photos, *video))))
    assert [record["ok"] for record in records] == [True] * 3, records
    photo, upright, shot = (np.load(out / record["file"]) for record in records)
    np.testing.assert_array_equal(photo, upright)
    np.testing.assert_array_equal(shot, upright)
    turned = np.rot90(np.load(out / records[1]["file"]))
    assert np.abs(turned[:32, :32] - upright[:32, :32]).max() > 0.01


# --- pixel shape and interlacing ----------------------------------------------


@pytest.mark.parametrize(("turned", "expected"), [(None, 2.0), ((90,), 0.5)])
def test_the_sample_aspect_ratio_is_part_of_the_camera(
    tmp_path, picture, turned, expected
):
    how = {"codec": "libx264", "pixels": "yuv420p", "turned": turned}
    write(tmp_path / "a.mp4", [picture], aspect=Fraction(2, 1), **how)
    frame = first_frame(tmp_path / "a.mp4")
    assert frame.grid.pixel_aspect_ratio == expected
    left, right, up, down = FieldOfView(40.0).tangents(frame.grid)
    ratio = expected * frame.grid.width_px / frame.grid.height_px
    assert (right - left) / (up - down) == pytest.approx(ratio)
    assert up == pytest.approx(np.tan(np.radians(20.0)))
    assert f"pixels are {expected:g} times as wide as high" in frame.notes[0]


def test_a_video_of_h264_keeps_the_shape_of_pixels(tmp_path, picture):
    from clients.batch.video_writing import VIDEO_KINDS, join_segments, write_segment

    how = {"kind": VIDEO_KINDS["h264"], "rate_hz": 10.0}
    write_segment(
        tmp_path / "a.mkv", [(0, picture)], pixel_aspect_ratio=lambda: 16 / 11, **how
    )
    join_segments(tmp_path / "a.mp4", [(0, tmp_path / "a.mkv")], **how)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].sample_aspect_ratio == Fraction(16, 11)


def test_an_interlaced_video_gets_a_note(tmp_path, picture):
    how = {"codec": "mpeg2video", "pixels": "yuv420p"}
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream(
            how["codec"], rate=25, options={"flags": "+ildct+ilme"}
        )
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert "interlaced" in first_frame(tmp_path / "a.mkv").notes[0]


# --- color -------------------------------------------------------------------

ORANGE = (200 / 255, 120 / 255, 30 / 255)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("matrix", WEIGHTS)
@pytest.mark.parametrize("bits", [8, 10])
def test_matrix_and_range_are_those_of_the_tags(tmp_path, matrix, full, bits):
    layout = "yuv420p" if bits == 8 else "yuv420p10le"
    tags = {"colorspace": matrix, "color_range": 2 if full else 1}
    tags |= {"color_primaries": BT709, "color_trc": BT709}
    planes = yuv420(ORANGE, matrix, bits=bits, full=full)
    write(tmp_path / "a.mkv", [planes], source=layout, pixels=layout, **tags)
    found = first_frame(tmp_path / "a.mkv")
    if bits == 8:
        assert found.pixels.dtype == np.uint8
        np.testing.assert_allclose(found.pixels[8, 8], [200, 120, 30], atol=3)
    else:
        expected = ((np.array(ORANGE) + 0.055) / 1.055) ** 2.4
        np.testing.assert_allclose(found.pixels[8, 8], expected, atol=0.004)
    assert not found.notes


def test_a_large_video_without_tags_is_bt709_and_a_small_one_bt601(
    tmp_path, monkeypatch
):
    from clients.batch import video_reading

    for bits, layout in ((8, "yuv420p"), (10, "yuv420p10le")):
        for matrix, height_px in ((BT601, 720), (BT709, HEIGHT_PX)):
            monkeypatch.setattr(video_reading, "HD_HEIGHT_PX", height_px)
            planes = yuv420(ORANGE, matrix, bits=bits)
            write(tmp_path / "a.mkv", [planes], source=layout, pixels=layout)
            pixels = first_frame(tmp_path / "a.mkv").pixels[8, 8]
            if bits == 8:
                np.testing.assert_allclose(pixels, [200, 120, 30], atol=3)
            else:
                expected = ((np.array(ORANGE) + 0.055) / 1.055) ** 2.4
                np.testing.assert_allclose(pixels, expected, atol=0.004)


def hdr(path, transfer, rgb):
    tags = {"colorspace": BT2020, "color_primaries": BT2020, "color_trc": transfer}
    planes = yuv420(rgb, BT2020, bits=10)
    how = {"source": "yuv420p10le", "pixels": "yuv420p10le", "color_range": 1}
    write(path, [planes], **how, **tags)
    return first_frame(path)


def test_hlg_is_converted_to_linear_light(tmp_path):
    """Reference white is 75 % of the signal and 203 cd/m2 (BT.2408, table 1)."""
    white = hdr(tmp_path / "a.mkv", HLG, (0.75, 0.75, 0.75))
    np.testing.assert_allclose(white.pixels[8, 8], 1.0, rtol=0.01)
    assert "HLG: 203 cd/m2 is white" in white.notes[0]
    peak = hdr(tmp_path / "a.mkv", HLG, (1.0, 1.0, 1.0))
    np.testing.assert_allclose(peak.pixels[8, 8], 1000.0 / 203.0, rtol=0.01)


def test_pq_is_converted_to_linear_light(tmp_path):
    """58 % of the signal are 203 cd/m2, and 75 % are 983 (BT.2408, ST 2084)."""
    white = hdr(tmp_path / "a.mkv", PQ, (0.58, 0.58, 0.58))
    np.testing.assert_allclose(white.pixels[8, 8], 1.0, rtol=0.02)
    bright = hdr(tmp_path / "a.mkv", PQ, (0.75, 0.75, 0.75))
    np.testing.assert_allclose(bright.pixels[8, 8], 983.0 / 203.0, rtol=0.02)


def test_primaries_of_bt2020_are_converted(tmp_path):
    """The green of BT.2020 has less than no red light of sRGB."""
    green = hdr(tmp_path / "a.mkv", PQ, (0.0, 0.5, 0.0)).pixels[8, 8]
    # BT.2087: columns of the matrix from BT.2020 to BT.709
    np.testing.assert_allclose(
        green / green[1], np.array([-0.5876, 1.1329, -0.1006]) / 1.1329, atol=0.02
    )


def test_bt2020_without_a_transfer_gets_a_note(tmp_path):
    planes = yuv420(ORANGE, BT2020, bits=10)
    tags = {"colorspace": BT2020, "color_range": 1}
    layout = "yuv420p10le"
    write(tmp_path / "a.mkv", [planes], source=layout, pixels=layout, **tags)
    assert (
        "does not say whether they are HLG or PQ"
        in first_frame(tmp_path / "a.mkv").notes[0]
    )


def test_a_matrix_that_is_not_supported_is_refused(tmp_path):
    planes = yuv420(ORANGE, BT2020, bits=10)
    layout = "yuv420p10le"
    tags = {"colorspace": 14, "color_range": 1}  # ICtCp
    write(tmp_path / "a.mkv", [planes], source=layout, pixels=layout, **tags)
    with pytest.raises(
        ValueError, match=r"color matrix 14; allowed: BT\.2020, BT\.601"
    ):
        first_frame(tmp_path / "a.mkv")


def test_transparent_pixels_of_a_video_are_black_and_noted(tmp_path, picture):
    rgba = np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)])
    rgba[:8, :, 3] = 0
    write(tmp_path / "a.mkv", [rgba], source="rgba", pixels="bgra")
    found = first_frame(tmp_path / "a.mkv")
    np.testing.assert_array_equal(found.pixels[8:], picture[8:])
    assert not found.pixels[:8].any()
    assert "25 % of the pixels are transparent" in found.notes[0]


def test_h264_of_a_batch_comes_back_with_its_colors(tmp_path):
    """Written with the tags of BT.709, whatever a player assumes without."""
    from clients.batch.video_writing import VIDEO_KINDS, write_segment

    image = np.full((HEIGHT_PX, WIDTH_PX, 3), (200, 120, 30), np.uint8)
    kind = VIDEO_KINDS["h264"]
    write_segment(tmp_path / "a.mkv", [(0, image)], kind=kind, rate_hz=10.0)
    with av.open(str(tmp_path / "a.mkv")) as container:
        frame = next(container.decode(video=0))
        assert (frame.colorspace, frame.color_range) == (BT709, 1)
    np.testing.assert_allclose(
        first_frame(tmp_path / "a.mkv").pixels[8, 8], [200, 120, 30], atol=3
    )


# --- times -------------------------------------------------------------------

TIMES_S = (0.0, 0.1, 0.2, 0.3, 1.1, 1.7, 2.2)


def test_a_variable_frame_rate_is_kept(tmp_path, picture):
    from clients.batch.video_writing import VIDEO_KINDS, join_segments, write_segment

    write(tmp_path / "a.mkv", [picture] * len(TIMES_S), times_s=TIMES_S)
    (tmp_path / "depth").mkdir()
    for k in range(len(TIMES_S)):
        np.save(tmp_path / f"depth/{k}.npy", np.ones(picture.shape[:2], np.float32))
    given = tmp_path / "depth", FieldOfView(40.0)
    _, frames = list_frames(tmp_path / "a.mkv", "auto", *given)
    times_s = [frame.time_s for frame in frames]
    np.testing.assert_allclose([float(t) for t in times_s], TIMES_S, atol=1e-9)
    for name in ("ffv1", "h264"):
        how = {"kind": VIDEO_KINDS[name], "rate_hz": 3.0}
        segments = [(0, tmp_path / "s0.mkv"), (4, tmp_path / "s4.mkv")]
        write_segment(segments[0][1], [(k, picture) for k in range(4)], **how)
        write_segment(segments[1][1], [(k, picture) for k in range(3)], **how)
        target = tmp_path / f"out{how['kind'].suffix}"
        join_segments(target, segments, times_s=times_s, **how)
        with av.open(str(target)) as container:
            found_s = [frame.time for frame in container.decode(video=0)]
        np.testing.assert_allclose(found_s, TIMES_S, atol=1e-3)


def test_a_constant_frame_rate_is_one_although_times_are_rounded(tmp_path, picture):
    write(tmp_path / "a.mkv", [picture] * 8, rate_hz=Fraction(30000, 1001))
    with av.open(str(tmp_path / "a.mkv")) as container:
        times_s = [frame.time for frame in container.decode(video=0)]
    assert times_s[:3] == [0.0, 0.033, 0.067]
    with reading.VideoReader(tmp_path / "a.mkv") as reader:
        assert reader.variable_times_s is None
        assert reader.rate_hz == pytest.approx(29.97, abs=0.001)
