"""Color and depth files: what is read is what was written, or a refusal by name."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from filter_service.image_files import (
    check_output,
    read_color,
    read_color_file,
    read_depth,
    read_depth_file,
    write_image,
)


@pytest.fixture
def linear(rng):
    return rng.random((5, 7, 3), dtype=np.float32) ** 8 * 40.0  # above 1: no clipping


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_linear_light_survives_a_file_exactly(tmp_path, linear, suffix):
    path = tmp_path / f"image{suffix}"
    write_image(path, linear)
    np.testing.assert_array_equal(read_color(path), linear)


def test_png_keeps_srgb_bytes_and_opaque_alpha(tmp_path, rng):
    srgb = rng.integers(0, 256, (5, 7, 4), dtype=np.uint8)
    srgb[..., 3] = 255
    Image.fromarray(srgb).save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(read_color(tmp_path / "rgba.png"), srgb[:, :, :3])


def test_gray_becomes_three_equal_channels(tmp_path):
    gray = np.arange(35, dtype=np.uint8).reshape(5, 7)
    Image.fromarray(gray).save(tmp_path / "gray.png")
    color = read_color(tmp_path / "gray.png")
    assert color.shape == (5, 7, 3)
    np.testing.assert_array_equal(color[:, :, 1], gray)


def test_exr_channels_come_back_in_rgb_order(tmp_path):
    path = tmp_path / "half.exr"
    half = np.zeros((4, 6, 4), np.float16)
    half[:] = [0.25, 0.5, 0.75, 1.0]
    header = {"type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": half}) as file:
        file.write(str(path))
    np.testing.assert_array_equal(read_color(path)[0, 0], [0.25, 0.5, 0.75])


@pytest.mark.parametrize(
    ("dtype", "depth_scale", "expected_m"),
    [
        (np.float32, None, [15.0, np.inf, 0.0]),
        (np.float64, 0.5, [7.5, np.inf, 0.0]),
    ],
)
def test_float_depth_keeps_infinity_and_holes(tmp_path, dtype, depth_scale, expected_m):
    np.save(tmp_path / "depth.npy", np.array([[15.0, np.inf, 0.0]], dtype))
    depth_m = read_depth(tmp_path / "depth.npy", depth_scale=depth_scale)
    assert depth_m.dtype == np.float32
    np.testing.assert_array_equal(depth_m, [expected_m])


@pytest.mark.parametrize(("depth_scale", "meters"), [(None, 1.5), (0.0002, 0.3)])
def test_16_bit_png_is_millimeters_unless_a_scale_is_given(
    tmp_path, depth_scale, meters
):
    Image.fromarray(np.array([[1500, 0]], np.uint16)).save(tmp_path / "depth.png")
    depth_m = read_depth(tmp_path / "depth.png", depth_scale=depth_scale)
    np.testing.assert_allclose(depth_m, [[meters, 0.0]], rtol=1e-6)


def test_8_bit_depth_wants_a_scale(tmp_path):
    Image.fromarray(np.array([[150, 0]], np.uint8)).save(tmp_path / "depth.png")
    with pytest.raises(ValueError, match=r"8 bits deep.*allowed.*16 bits in mm"):
        read_depth(tmp_path / "depth.png")
    depth_m = read_depth(tmp_path / "depth.png", depth_scale=0.02)
    np.testing.assert_allclose(depth_m, [[3.0, 0.0]], rtol=1e-6)


def test_float_tiff_and_exr_depth_are_meters(tmp_path, rng):
    meters = rng.random((5, 7), dtype=np.float32)
    Image.fromarray(meters).save(tmp_path / "depth.tif")
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.tif"), meters)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": meters}) as file:
        file.write(str(tmp_path / "depth.exr"))
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.exr"), meters)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros((4, 6), np.float32), "shape"),
        (np.zeros((0, 6, 3), np.float32), "shape"),
        (np.zeros((4, 6, 3), np.int32), "int32"),
    ],
)
def test_unfit_color_is_refused_with_what_was_found(tmp_path, array, said):
    np.save(tmp_path / "color.npy", array)
    with pytest.raises(ValueError, match=said) as caught:
        read_color(tmp_path / "color.npy")
    assert "--color" in str(caught.value)
    assert "allowed" in str(caught.value)


def test_light_below_zero_and_not_finite_is_left_to_the_filter(tmp_path):
    light = np.array([[[-0.25, 1e30, np.nan]], [[np.inf, 70000.0, 0.5]]], np.float32)
    for name in ("color.npy", "color.exr"):
        write_image(tmp_path / name, light)
        np.testing.assert_array_equal(read_color(tmp_path / name), light)


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_half_floats_survive_a_file_exactly(tmp_path, linear, suffix):
    path = tmp_path / f"image{suffix}"
    write_image(path, linear.astype(np.float16))
    np.testing.assert_array_equal(read_color(path), linear.astype(np.float16))
    write_image(tmp_path / f"float{suffix}", linear)
    size = path.stat().st_size
    assert size < (tmp_path / f"float{suffix}").stat().st_size


@pytest.mark.parametrize("name", ["depth.exr", "depth.png", "depth.npy", "depth.jpg"])
def test_a_depth_file_that_is_none_is_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="--depth"):
        read_depth(tmp_path / name)


def test_color_with_three_channels_is_no_depth(tmp_path):
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(tmp_path / "depth.png")
    with pytest.raises(ValueError, match="one channel"):
        read_depth(tmp_path / "depth.png")


def test_a_pickled_array_is_not_loaded(tmp_path):
    np.save(tmp_path / "color.npy", np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(ValueError, match="cannot be read"):
        read_color(tmp_path / "color.npy")


def test_outputs_are_checked_before_any_work(tmp_path):
    check_output(tmp_path / "out.PNG")
    with pytest.raises(ValueError, match=r"\.png, \.npy, \.exr"):
        check_output(tmp_path / "out.jpg")
    with pytest.raises(ValueError, match="folder"):
        check_output(tmp_path / "missing" / "out.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match="it is a folder"):
        check_output(tmp_path / "folder.png")


def test_a_type_that_does_not_fit_the_file_is_refused(tmp_path, linear):
    with pytest.raises(ValueError, match="uint8"):
        write_image(tmp_path / "out.png", linear)


# --- units ---------------------------------------------------------------------


def depth_file(path, values, **how):
    np.save(path, np.asarray(values))
    return read_depth_file(path, **how)


def test_integers_of_an_array_are_millimeters_with_a_note(tmp_path):
    found = depth_file(tmp_path / "a.npy", np.full((4, 5), 1500, np.int32))
    np.testing.assert_allclose(found.pixels, 1.5)
    (note,) = found.notes
    assert note == "'a.npy': integers are millimeters unless --depth-scale is given"
    told = depth_file(tmp_path / "a.npy", np.full((4, 5), 2, np.int32), depth_scale=1.0)
    np.testing.assert_array_equal(told.pixels, 2.0)
    assert not told.notes


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.linspace(211.0, 502.0, 20), "depth of 214 to 499 m is unusual"),
        (np.linspace(0.001, 0.005, 20), "depth of 0.00104 to 0.00496 m is unusual"),
        (-np.linspace(1.0, 5.0, 20), "all depth is negative and therefore missing"),
    ],
)
def test_doubtful_depth_gets_a_note(tmp_path, values, said):
    values = values.reshape(4, 5).astype(np.float32)
    found = depth_file(tmp_path / "a.npy", values)
    np.testing.assert_array_equal(found.pixels, values)
    (note,) = found.notes
    assert said in note
    with pytest.warns(UserWarning, match="a.npy"):
        read_depth(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "values",
    [[0.3, 2.0, np.inf, np.nan], [np.inf] * 4, [0.0] * 4, [-1.0, 3.0, 80.0, 9e9]],
)
def test_usual_depth_gets_no_note(tmp_path, values):
    assert not depth_file(tmp_path / "a.npy", np.float32([values])).notes


@pytest.mark.parametrize("suffix", [".png", ".npy", ".tif"])
def test_65535_is_no_return(tmp_path, suffix):
    values = np.array([[1500, 65535, 65534, 0]], np.uint16)
    path = tmp_path / f"a{suffix}"
    np.save(path, values) if suffix == ".npy" else Image.fromarray(values).save(path)
    found = read_depth_file(path)
    np.testing.assert_allclose(found.pixels, [[1.5, 0.0, 65.534, 0.0]], rtol=1e-6)
    assert "25 % of the depth is 65535: missing" in found.notes[-1]


def test_floats_of_0_to_255_get_a_note(tmp_path, rng):
    light = rng.integers(0, 256, (4, 5, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", light)
    found = read_color_file(tmp_path / "a.npy")
    np.testing.assert_array_equal(found.pixels, light)
    assert found.notes[0].endswith("is it 0 to 255?")
    light /= 255.0
    light[0, 0] = 50.0  # a lamp
    np.save(tmp_path / "a.npy", light)
    assert not read_color_file(tmp_path / "a.npy").notes
