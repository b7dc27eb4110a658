"""Layouts of data sets, read against numbers worked out by hand."""

import math
import re
from contextlib import closing

import numpy as np
import pytest
from PIL import Image

from clients.batch.datasets import counted_depth_m, registered_m
from clients.batch.layouts import list_frames, optics_of
from clients.batch.source import (
    FieldOfView,
    Pinhole,
    Scaled,
    States,
    center_depth_m,
    read_states,
)
from clients.batch.work import Job, Unit, UnitRunner
from filter_service.camera import PixelGrid
from filter_service.settings import FilterSettings

FOV = {"optics": FieldOfView(40.0)}


def write_color(path, width_px=4, height_px=2, value=(10, 20, 30)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (width_px, height_px), value).save(path)


def write_integers(path, rows, dtype=np.uint16):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.array(rows, dtype)).save(path)


def write_pfm(path, rows):
    rows = np.array(rows, "<f4")
    head = f"Pf\n{rows.shape[1]} {rows.shape[0]}\n-1.0\n"
    path.write_bytes(head.encode() + rows[::-1].tobytes())  # the lowest row is first


# --- TUM RGB-D ---------------------------------------------------------------


@pytest.fixture
def tum(tmp_path):
    for time in ("1.000000", "1.033000", "1.066000", "2.000000"):
        write_color(tmp_path / f"rgb/{time}.png")
    for k, time in enumerate(("0.998000", "1.047000", "1.050000")):
        write_integers(tmp_path / f"depth/{time}.png", [[5000 * (k + 1), 0, 1, 65535]])
    lists = {
        "rgb": ("1.000000", "1.033000", "1.066000", "2.000000"),
        "depth": ("0.998000", "1.047000", "1.050000"),
    }
    for name, times in lists.items():
        lines = [f"{time} {name}/{time}.png" for time in times]
        text = "\n".join(["# timestamp filename", *lines]) + "\n"
        (tmp_path / f"{name}.txt").write_text(text)
    return tmp_path


def test_tum_joins_what_is_nearest_in_time_and_uses_each_once(tum):
    layout, frames = list_frames(tum, "auto")
    assert layout == "tum"
    # 14 ms and 16 ms apart; 1.066 lies 19 ms from 1.047, too, but that one is taken
    assert [(frame.name, frame.depth.name) for frame in frames] == [
        ("1.000000", "0.998000.png"),
        ("1.033000", "1.047000.png"),
        ("1.066000", "1.050000.png"),
    ]


def test_tum_depth_is_5000_units_a_meter_and_0_and_65535_are_missing(tum):
    _, frames = list_frames(tum, "auto")
    depth_m = frames[0].depth_form.read(frames[0].depth).pixels
    np.testing.assert_allclose(depth_m, [[1.0, 0.0, 0.0002, 0.0]], rtol=1e-6)


def test_tum_has_the_camera_of_the_driver_unless_told_otherwise(tum):
    _, frames = list_frames(tum, "auto")
    left, right, up, down = frames[0].optics.tangents(PixelGrid(640, 480))
    np.testing.assert_allclose([left, right], [-320 / 525, 320 / 525])
    np.testing.assert_allclose([up, down], [240 / 525, -240 / 525])
    _, frames = list_frames(tum, "auto", optics=Pinhole(100.0, 50.0, 0.0, 0.0))
    np.testing.assert_allclose(
        frames[0].optics.tangents(PixelGrid(4, 2)), [-0.005, 0.035, 0.01, -0.03]
    )


@pytest.mark.parametrize("order", ["color first", "depth first"])
def test_tum_takes_a_list_of_pairs_as_it_stands(tum, order):
    parts = ["1.0 rgb/1.000000.png", "2.0 depth/1.050000.png"]
    parts = parts if order == "color first" else parts[::-1]
    (tum / "associations.txt").write_text(" ".join(parts) + "\n")
    _, (frame,) = list_frames(tum, "auto")
    assert (frame.name, frame.depth.name) == ("1.000000", "1.050000.png")


def test_a_list_that_cannot_be_read_is_refused_by_its_line(tum):
    (tum / "rgb.txt").write_text("# times\n1.0 rgb/1.000000.png\nsoon rgb/2.png\n")
    with pytest.raises(ValueError, match=r"rgb\.txt': line 3: 'soon' is not a time"):
        list_frames(tum, "auto")


# --- Middlebury --------------------------------------------------------------

CALIBRATION = """cam0=[4000 0 1.25; 0 4000 0.5; 0 0 1]
cam1=[4000 0 2; 0 4000 0.5; 0 0 1]
doffs=100
baseline=200
width=4
height=2
ndisp=290
"""


def write_scene(folder):
    write_color(folder / "im0.png")
    write_pfm(folder / "disp0.pfm", [[100, 300, np.inf, 0], [60, 700, np.inf, 1500]])
    (folder / "calib.txt").write_text(CALIBRATION)


def test_middlebury_depth_is_focal_length_times_baseline_over_disparity(tmp_path):
    write_scene(tmp_path / "Piano")
    write_scene(tmp_path / "Adirondack")
    layout, frames = list_frames(tmp_path, "auto")
    assert layout == "middlebury"
    assert [frame.name for frame in frames] == ["Adirondack", "Piano"]
    depth_m = frames[0].depth_form.read(frames[0].depth).pixels
    # 4000 px 0.2 m = 800 px m; over 200, 400, unknown, 100; 160, 800, unknown, 1600
    np.testing.assert_allclose(depth_m, [[4, 2, 0, 8], [5, 1, 0, 0.5]])


def test_middlebury_has_its_calibrations_camera(tmp_path):
    write_scene(tmp_path)
    _, (frame,) = list_frames(tmp_path, "auto")
    np.testing.assert_allclose(
        frame.optics.tangents(PixelGrid(4, 2)),
        [-1.75 / 4000, 2.25 / 4000, 1.0 / 4000, -1.0 / 4000],
    )
    assert frame.name == tmp_path.name


def test_a_calibration_without_a_baseline_is_refused(tmp_path):
    write_scene(tmp_path)
    text = CALIBRATION.replace("baseline", "base")
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(ValueError, match=r"calib\.txt': 'baseline' is missing"):
        list_frames(tmp_path, "auto")


# --- NYU depth v2 ------------------------------------------------------------


def test_nyu_pairs_are_millimeters_with_the_color_camera_of_the_toolbox(tmp_path):
    write_color(tmp_path / "00001_colors.png")
    write_integers(tmp_path / "00001_depth.png", [[1500, 0, 9999, 1]] * 2)
    layout, (frame,) = list_frames(tmp_path, "auto")
    assert (layout, frame.name) == ("nyu", "00001")
    depth_m = frame.depth_form.read(frame.depth).pixels
    np.testing.assert_allclose(depth_m[0], [1.5, 0.0, 9.999, 0.001], rtol=1e-6)
    left, right, _, _ = frame.optics.tangents(PixelGrid(640, 480))
    np.testing.assert_allclose(right - left, 640 / 518.857901, rtol=1e-8)


def test_a_camera_of_other_images_is_refused(tmp_path):
    write_color(tmp_path / "00001_colors.png")
    write_integers(tmp_path / "00001_depth.png", [[1, 2, 3, 4]] * 2)
    _, (frame,) = list_frames(tmp_path, "auto")
    with pytest.raises(ValueError, match=r"4x2 px, but the camera .* is for 640x480"):
        frame.optics.tangents(PixelGrid(4, 2))


def test_pairs_that_are_only_like_nyu_are_not_taken_for_it(tmp_path):
    write_color(tmp_path / "rgb_0001.png")
    write_integers(tmp_path / "depth_0001.png", [[1, 2, 3, 4]] * 2)
    layout, (frame,) = list_frames(tmp_path, "auto", **FOV)
    assert (layout, frame.name) == ("pairs", "0001")


def test_nyu_pairs_have_other_names_too(tmp_path):
    write_color(tmp_path / "rgb_00045.jpg")
    write_integers(tmp_path / "sync_depth_00045.png", [[1500, 0, 9999, 1]] * 2)
    layout, (frame,) = list_frames(tmp_path, "auto")
    assert (layout, frame.name) == ("nyu", "00045")
    assert frame.depth.name == "sync_depth_00045.png"


def test_nyu_counts_are_turned_into_meters_by_the_toolbox_formula():
    # beyond 1092.5 - 35.13 = 1057.37 it is more than 10 m, then less than 0
    counts = np.array([[741, 1057, 1058, 2047, 0]], np.uint16)
    np.testing.assert_allclose(
        counted_depth_m(counts),
        [[351.3 / 351.5, 351.3 / 35.5, 0.0, 0.0, 351.3 / 1092.5]],
    )


def test_nyu_raw_depth_is_put_where_the_color_camera_sees_it():
    depth_m = np.zeros((480, 640))
    depth_m[238, 313] = 2.0  # on the depth camera's axis but for 0.05 and 0.44 px
    seen_m = registered_m(depth_m)
    (row,), (column,) = np.nonzero(seen_m)
    # Turned back, (0, 0, 2) m is -(-0.0086, 0.0073, 2); moved by 25, -0.3 and 0.7 mm
    # (0.0337, -0.0076, -1.9993).  That is 518.9 x / z = -8.7 px from the center at
    # 325.6, and 519.5 y / z = 2.0 px, less the 0.4 px off the axis, from 253.7.
    assert (row, column) == (255, 317)
    assert seen_m[row, column] == pytest.approx(1.9993, abs=1e-4)


def test_nyu_raw_frames_take_the_depth_nearest_in_time(tmp_path):
    for time in ("100.00", "100.50"):
        write_color(tmp_path / f"r-{time}-7.ppm", 640, 480)
    swapped = np.full((480, 640), 741, np.uint16).astype("<u2").tobytes()
    for time in ("99.90", "100.45", "100.60"):
        path = tmp_path / f"d-{time}-9.pgm"
        path.write_bytes(b"P5\n640 480\n65535\n" + swapped)
    layout, frames = list_frames(tmp_path, "auto")
    assert layout == "nyu"
    assert [frame.depth.name for frame in frames] == ["d-99.90-9.pgm", "d-100.45-9.pgm"]
    depth_m = frames[0].depth_form.read(frames[0].depth).pixels
    known_m = depth_m[depth_m > 0.0]
    assert known_m.size > 0.5 * depth_m.size
    # a flat wall, seen by a camera that is turned by less than half a degree
    np.testing.assert_allclose(known_m, 351.3 / 351.5, atol=0.01)


# --- pairs -------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".exr", ".pfm"])
def test_pairs_in_two_folders_take_every_kind_of_depth(tmp_path, suffix):
    import OpenEXR

    write_color(tmp_path / "color/a.png")
    path = tmp_path / f"depth/a{suffix}"
    path.parent.mkdir()
    depth_m = np.array([[0.5, 1, 2, 3], [4, 5, 6, 7]], np.float32)
    if suffix == ".png":
        write_integers(path, 1000 * depth_m)
    elif suffix == ".npy":
        np.save(path, depth_m)
    elif suffix == ".exr":
        header = {"type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"Z": depth_m}) as file:
            file.write(str(path))
    elif suffix == ".pfm":
        write_pfm(path, depth_m)
    else:
        Image.fromarray(depth_m).save(path)
    layout, (frame,) = list_frames(tmp_path, "auto", **FOV)
    assert (layout, frame.name) == ("pairs", "a")
    np.testing.assert_array_equal(frame.depth_form.read(frame.depth).pixels, depth_m)


def test_pairs_beside_each_other_are_told_apart_by_their_names(tmp_path):
    for k in (1, 2):
        write_color(tmp_path / f"{k}_color.png")
        write_integers(tmp_path / f"{k}_depth.png", [[1, 2, 3, 4]] * 2)
    _, frames = list_frames(tmp_path, "auto", **FOV)
    assert [(f.name, f.color.name, f.depth.name) for f in frames] == [
        ("1", "1_color.png", "1_depth.png"),
        ("2", "2_color.png", "2_depth.png"),
    ]


def test_a_file_without_a_partner_is_a_fault_of_its_own(tmp_path):
    write_color(tmp_path / "rgb/a.png")
    write_color(tmp_path / "rgb/b.png")
    write_integers(tmp_path / "depth/b.png", [[1, 2, 3, 4]] * 2)
    _, (first, second) = list_frames(tmp_path, "auto", **FOV)
    assert "no depth with the name 'a'" in first.fault
    assert second.fault is None


def test_a_scale_that_is_told_is_used(tmp_path):
    write_color(tmp_path / "rgb/a.png")
    write_integers(tmp_path / "depth/a.png", [[1, 2, 3, 4]] * 2)
    told = None, FieldOfView(40.0), 0.25
    _, (frame,) = list_frames(tmp_path, "auto", *told)
    assert frame.depth_form == Scaled(0.25)
    np.testing.assert_array_equal(
        frame.depth_form.read(frame.depth).pixels[0], [0.25, 0.5, 0.75, 1.0]
    )


def test_without_a_calibration_the_field_of_view_is_asked_for(tmp_path):
    write_color(tmp_path / "rgb/a.png")
    write_integers(tmp_path / "depth/a.png", [[1, 2, 3, 4]] * 2)
    with pytest.raises(ValueError, match="--fov-deg is not given"):
        list_frames(tmp_path, "auto")
    with pytest.raises(ValueError, match=r"--fov-deg is 400; allowed: 1 to 150"):
        optics_of(400.0, None)
    with pytest.raises(ValueError, match=r"--intrinsics is '1,2'; allowed: FX,FY"):
        optics_of(None, "1,2")


def test_a_field_of_view_is_the_vertical_one():
    left, right, up, down = FieldOfView(90.0).tangents(PixelGrid(200, 100))
    np.testing.assert_allclose([left, right, up, down], [-2.0, 2.0, 1.0, -1.0])


# --- videos ------------------------------------------------------------------


def write_video(path, images, codec, pixels, source, **options):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        height_px, width_px = images[0].shape[:2]
        stream.width, stream.height, stream.pix_fmt = width_px, height_px, pixels
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format=source)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def test_frames_of_videos_are_read_by_their_numbers_in_any_order(tmp_path, rng):
    """Groups of 5 pictures: a frame in the middle needs those before it."""
    from clients.batch.video_reading import VideoReader

    grays = 10 * np.arange(20) + 20
    colors = [np.full((32, 48, 3), gray, np.uint8) for gray in grays]
    write_video(tmp_path / "c.mp4", colors, "libx264", "yuv420p", "rgb24", g="5")
    depths = [rng.integers(0, 65536, (32, 48)).astype(np.uint16) for _ in range(20)]
    write_video(tmp_path / "d.mkv", depths, "ffv1", "gray16le", "gray16le")
    with VideoReader(tmp_path / "c.mp4") as reader:
        assert (reader.count, reader.rate_hz) == (20, 25.0)
        for index in (0, 1, 2, 13, 3, 19, 12, 13):
            assert abs(reader.color(index).pixels.mean() - grays[index]) < 3.0
    with VideoReader(tmp_path / "d.mkv") as reader:
        for index in (7, 8, 2, 19):
            np.testing.assert_array_equal(reader.integers(index), depths[index])


class ReadOnly(States):
    """States that end the work on a frame once it is read."""

    def of(self, name, depth_m):
        raise ValueError(f"read {depth_m.min():g} m to {depth_m.max():g} m")


def test_depth_of_a_video_is_scaled_and_other_pixels_are_refused(tmp_path):
    from clients.batch.video_reading import VideoReader

    colors = [np.full((32, 48, 3), 99, np.uint8)] * 3
    write_video(tmp_path / "c.mkv", colors, "ffv1", "bgr0", "rgb24")
    depths = [np.full((32, 48), 1000 * (k + 1), np.uint16) for k in range(3)]
    write_video(tmp_path / "d.mkv", depths, "ffv1", "gray16le", "gray16le")
    told = tmp_path / "d.mkv", FieldOfView(40.0), 0.0005
    layout, frames = list_frames(tmp_path / "c.mkv", "auto", *told)
    assert (layout, [f.name for f in frames]) == (
        "video",
        ["000000", "000001", "000002"],
    )
    told = tmp_path / "c.mkv", FieldOfView(40.0)
    _, others = list_frames(tmp_path / "c.mkv", "auto", *told)
    with VideoReader(frames[2].color) as reader:
        assert (reader.color(frames[2].color_index).pixels == 99).all()
    job = Job({}, FilterSettings(), ReadOnly(4.0, 0.0))
    with closing(UnitRunner(job, tmp_path)) as runner:
        read, refused = runner.run(Unit(0, "eye", (frames[2], others[0])))
    assert read["error"] == "read 1.5 m to 1.5 m"
    assert re.search("pixels are .*; allowed: lossless 16-bit", refused["error"])


def test_a_video_wants_as_many_depths_as_it_has_frames(tmp_path):
    colors = [np.full((32, 48, 3), 99, np.uint8)] * 3
    write_video(tmp_path / "c.mkv", colors, "ffv1", "bgr0", "rgb24")
    write_integers(tmp_path / "depth/0.png", np.ones((32, 48)))
    with pytest.raises(ValueError, match=r"1 frames; allowed: 3, as in"):
        told = tmp_path / "depth", FieldOfView(40.0)
        list_frames(tmp_path / "c.mkv", "auto", *told)
    with pytest.raises(ValueError, match="--depth is not given"):
        list_frames(tmp_path / "c.mkv", "auto", **FOV)


def test_segments_become_one_video_in_which_a_gap_is_time(tmp_path, rng):
    import av

    from clients.batch.video_writing import VIDEO_KINDS, join_segments, write_segment

    images = rng.integers(0, 256, (5, 30, 40, 3), dtype=np.uint8)
    kind = {"kind": VIDEO_KINDS["ffv1"], "rate_hz": 30000 / 1001}
    write_segment(tmp_path / "a.mkv", enumerate(images[:2]), **kind)
    write_segment(tmp_path / "b.mkv", [(0, images[2]), (2, images[4])], **kind)
    segments = [(0, tmp_path / "a.mkv"), (2, tmp_path / "b.mkv")]
    for name in ("whole", "again"):
        join_segments(tmp_path / f"{name}.mkv", segments, **kind)
    whole, again = (tmp_path / f"{name}.mkv" for name in ("whole", "again"))
    assert whole.read_bytes() == again.read_bytes()
    with av.open(str(whole)) as container:
        frames = list(container.decode(video=0))
    times_s = [frame.time for frame in frames]
    np.testing.assert_allclose(times_s, np.array([0, 1, 2, 4]) * 1.001 / 30, atol=1e-3)
    for frame, number in zip(frames, (0, 1, 2, 4), strict=True):
        np.testing.assert_array_equal(frame.to_ndarray(format="rgb24"), images[number])


def test_h264_wants_even_sides(tmp_path):
    from clients.batch.video_writing import VIDEO_KINDS, write_segment

    with pytest.raises(ValueError, match="41x30 px; allowed: even width and height"):
        write_segment(
            tmp_path / "a.mkv",
            [(0, np.zeros((30, 41, 3), np.uint8))],
            kind=VIDEO_KINDS["h264"],
            rate_hz=30.0,
        )


# --- states ------------------------------------------------------------------


def test_the_middles_depth_is_the_median_of_what_is_known_there():
    depth_m = np.full((100, 200), 9.0, np.float32)
    depth_m[45:55, 90:110] = 2.0
    depth_m[45:51, 90:110] = 0.0  # missing
    assert center_depth_m(depth_m) == 2.0
    depth_m[40:60, 80:120] = np.nan
    assert center_depth_m(depth_m) == 9.0  # of a larger middle
    assert center_depth_m(np.zeros((4, 4), np.float32)) == math.inf


def test_focus_at_the_center_is_in_diopters_and_within_reach():
    states = States(3.0, None)
    assert states.of("a", np.full((8, 8), 0.5, np.float32)) == (3.0, 2.0)
    assert states.of("a", np.full((8, 8), np.inf, np.float32)) == (3.0, 0.0)
    assert states.of("a", np.full((8, 8), 0.01, np.float32)) == (3.0, 10.0)


def test_a_list_of_states_says_pupil_and_focus_by_name_or_number(tmp_path):
    path = tmp_path / "states.csv"
    path.write_text("frame, pupil_mm, focus_dpt\n0, 3.5, 0.25\n000001, 5, 1\n")
    names = ["000000", "000001"]
    states = States(4.0, 0.0, read_states(path, names))
    states.check(names)
    assert states.of("000000", np.ones((2, 2), np.float32)) == (3.5, 0.25)
    assert states.pupil_range_mm == (3.5, 5.0)
    assert states.focus_range_dpt == (0.25, 1.0)
    with pytest.raises(ValueError, match="no line for frame '000002'"):
        states.check([*names, "000002"])
    path.write_text("frame,pupil_mm\n0,99\n")
    with pytest.raises(ValueError, match=r"line 2: pupil_mm '99'; allowed: 0\.5 to 9"):
        read_states(path, names)
