"""OpenEXR files: place and shape of pixels, primaries, channels and parts."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from filter_service.image_files import (
    read_color,
    read_color_file,
    read_depth_file,
    write_image,
)


def read_noted(path, said):
    """Read a picture of color; return its pixels, and check its only note."""
    found = read_color_file(path)
    (note,) = found.notes
    assert said in note
    return found.pixels


def exr(path, channels, **header):
    header = {"type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


@pytest.fixture
def light(rng):
    return rng.random((4, 6, 3), np.float32)


def test_a_part_of_a_picture_is_seen_as_a_part(tmp_path, light):
    """2 px from the left and 1 px from the top of 12x8 px."""
    path = exr(
        tmp_path / "a.exr",
        {"RGB": light},
        dataWindow=((2, 1), (7, 4)),
        displayWindow=((0, 0), (11, 7)),
    )
    found = read_color_file(path)
    assert "6x4 px of a picture of 12x8" in found.notes[0]
    # 2 px of the picture, at 1 px depth, per 90 deg: 4 px are 1
    np.testing.assert_allclose(found.grid.fov_tangents(90.0), [-1.0, 0.5, 0.75, -0.25])
    tangents = found.grid.intrinsics_tangents(4.0, 4.0, 5.5, 3.5)
    np.testing.assert_allclose(tangents, [-1.0, 0.5, 0.75, -0.25])
    write_image(tmp_path / "b.exr", found.pixels, grid=found.grid)
    again = read_color_file(tmp_path / "b.exr")
    assert again.grid == found.grid
    np.testing.assert_array_equal(again.pixels, light)


def test_parts_at_different_places_do_not_fit(tmp_path, light):
    window = {"displayWindow": ((0, 0), (11, 7))}
    color, depth = (
        read(exr(tmp_path / "a.exr", channels, dataWindow=at, **window))
        for read, channels, at in (
            (read_color_file, {"RGB": light}, ((2, 1), (7, 4))),
            (read_depth_file, {"Z": light[..., 0].copy()}, ((3, 1), (8, 4))),
        )
    )
    assert color.grid.difference(depth.grid) == (
        "at 3,1 px of 12x8",
        "at 2,1 px of 12x8",
    )
    assert color.grid.difference(color.grid) is None


def test_the_shape_of_pixels_is_part_of_the_camera(tmp_path, light):
    found = read_color_file(
        exr(tmp_path / "a.exr", {"RGB": light}, pixelAspectRatio=2.0)
    )
    assert "pixels are 2 times as wide as high" in found.notes[0]
    left, right, up, _ = found.grid.fov_tangents(90.0)
    np.testing.assert_allclose([left, right, up], [-3.0, 3.0, 1.0])
    path = exr(tmp_path / "a.exr", {"RGB": light}, pixelAspectRatio=20.0)
    with pytest.raises(
        ValueError, match=r"pixelAspectRatio of 20; allowed: 0\.1 to 10"
    ):
        read_color_file(path)


def test_chromaticities_of_exr_are_converted(tmp_path):
    """White stays white; a color of ACES AP1 by the matrix of the Academy."""
    ap1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
    light = np.ones((2, 3, 3), np.float32)
    light[0, 0] = (0.5, 0.2, 0.1)
    found = read_color(exr(tmp_path / "a.exr", {"RGB": light}, chromaticities=ap1))
    np.testing.assert_allclose(found[1], 1.0, atol=2e-4)
    to_srgb = [
        [1.70505, -0.62179, -0.08326],
        [-0.13026, 1.14080, -0.01055],
        [-0.02400, -0.12897, 1.15297],
    ]
    np.testing.assert_allclose(found[0, 0], to_srgb @ light[0, 0], atol=5e-4)


def test_opacity_gray_and_parts_of_exr(tmp_path, light):
    alpha = np.ones(light.shape[:2], np.float32)
    alpha[0] = 0.5
    path = exr(tmp_path / "a.exr", {"RGBA": np.dstack([light, alpha])})
    np.testing.assert_array_equal(read_noted(path, "25 % of the pixels are"), light)
    gray = read_color(exr(tmp_path / "a.exr", {"Y": light[..., 0].copy()}))
    np.testing.assert_array_equal(gray, np.repeat(light[..., :1], 3, axis=2))
    with pytest.raises(ValueError, match="channels V; allowed: channels R, G and B of"):
        read_color(exr(tmp_path / "a.exr", {"V": light[..., 0].copy()}))
    parts = [
        OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage}, {"RGB": image})
        for name, image in (("left", light), ("right", light / 2))
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "b.exr"))
    found = read_noted(tmp_path / "b.exr", "it has 2 parts; the first is read")
    np.testing.assert_array_equal(found, light)


def layers(light, *names):
    parts = dict(zip("RGB", np.moveaxis(light, -1, 0).copy(), strict=True))
    return {f"{name}.{c}": part for name in names for c, part in parts.items()}


def test_the_only_layer_of_a_renderer_is_read(tmp_path, light):
    """As Blender names channels: ViewLayer.Combined.R and ViewLayer.Depth.Z."""
    combined = layers(light, "ViewLayer.Combined")
    combined["ViewLayer.Combined.A"] = np.full(light.shape[:2], 0.5, np.float32)
    combined["ViewLayer.Depth.Z"] = light[..., 0] + 1.0
    normal = {f"ViewLayer.Normal.{c}": -light[..., 0] for c in "XYZ"}
    path = exr(tmp_path / "a.exr", combined | normal)
    color, depth = read_color_file(path), read_depth_file(path)
    np.testing.assert_array_equal(color.pixels, light)
    assert "100 % of the pixels are transparent" in color.notes[0]
    assert color.notes[1] == "'a.exr': the layer 'ViewLayer.Combined' is read"
    np.testing.assert_array_equal(depth.pixels, light[..., 0] + 1.0)
    assert "the layer 'ViewLayer.Depth' is read" in depth.notes[0]
    path = exr(tmp_path / "a.exr", layers(light, "a.diffuse", "a.glossy"))
    with pytest.raises(ValueError, match=r"channels a\.diffuse\.B, .* of one layer"):
        read_color_file(path)


def test_colors_are_no_depth(tmp_path, light):
    with pytest.raises(ValueError, match="colors in R, G and B; allowed: a channel Z"):
        read_depth_file(exr(tmp_path / "a.exr", {"RGB": light}))
    same = np.repeat(light[..., :1], 3, axis=2)
    found = read_depth_file(exr(tmp_path / "a.exr", {"RGB": same}))
    np.testing.assert_array_equal(found.pixels, light[..., 0])
    image = Image.fromarray(np.zeros((4, 6), np.uint8)).convert("P")
    image.save(tmp_path / "a.png")
    with pytest.raises(ValueError, match="a palette of colors; allowed: one channel"):
        read_depth_file(tmp_path / "a.png", depth_scale=0.1)
