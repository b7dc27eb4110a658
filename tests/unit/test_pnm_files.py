"""PGM, PPM and TIFF files of 16 bits, and textures as stored."""

import io

import numpy as np
import pytest
import tifffile
from PIL import Image

from filter_service.image_files import read_color, read_depth_file
from filter_service.pictures import read_picture_srgb8, read_texture
from tests.unit.image_bytes import matrix_profile, pnm
from tests.unit.test_picture_colors import linear_of


@pytest.fixture
def srgb(rng):
    return rng.integers(0, 256, (9, 13, 3), dtype=np.uint8)


@pytest.fixture
def deep(rng):
    return rng.integers(0, 65536, (9, 13, 3)).astype(np.uint16)


def test_a_tiff_of_16_bits_on_the_page(tmp_path, deep):
    tifffile.imwrite(tmp_path / "a.tif", deep[..., :3], photometric="rgb")
    found, notes = read_picture_srgb8(tmp_path / "a.tif")
    np.testing.assert_array_equal(found, deep[..., :3] >> 8)
    assert notes == ["16 bits per channel are read as 8"]
    tifffile.imwrite(tmp_path / "a.tif", deep[..., 0], photometric="minisblack")
    found, notes = read_picture_srgb8(tmp_path / "a.tif")
    np.testing.assert_allclose(found[..., 1], deep[..., 0] / 257.0, atol=0.51)


@pytest.mark.parametrize("kind", ["P3", "P6"])
@pytest.mark.parametrize("top", [200, 255, 1023, 65535])
def test_a_ppm_of_any_maximum(tmp_path, rng, kind, top):
    values = rng.integers(0, top + 1, (5, 7, 3))
    found = read_color(pnm(tmp_path / "a.ppm", kind, values, top))
    if top < 256:
        np.testing.assert_allclose(found, values * (255.0 / top), atol=0.5)
    else:
        np.testing.assert_allclose(found, linear_of(values, top), atol=2e-5)


@pytest.mark.parametrize("kind", ["P2", "P5"])
@pytest.mark.parametrize("top", [4000, 65535])
def test_depth_of_a_pgm_does_not_depend_on_its_maximum(tmp_path, rng, kind, top):
    values = rng.integers(400, 4000, (5, 7))
    depth = read_depth_file(pnm(tmp_path / "a.pgm", kind, values, top))
    np.testing.assert_allclose(depth.pixels, values * 0.001, rtol=1e-6)


@pytest.mark.parametrize(
    "content",
    [
        b"P5\n4 4\n70000\n" + bytes(64),
        b"P5\n4 0\n255\n",
        b"P5\n4 4\n255\n" + bytes(15),
        b"P5\n4 4\n100\n" + b"\xff" * 16,
        b"P2\n2 1\n255\n1 -5",
        b"P2\n2 1\n255\n1 x",
        b"P6 4",
        b"P5\n99999 99999\n255\n",
    ],
)
def test_damaged_pgm_files_are_refused(tmp_path, content):
    (tmp_path / "a.pgm").write_bytes(content)
    with pytest.raises(ValueError, match=r"--depth .*a\.pgm'.*allowed: "):
        read_depth_file(tmp_path / "a.pgm")


def test_a_texture_of_gltf_is_as_stored(srgb):
    rgba = np.dstack([srgb, np.zeros(srgb.shape[:2], np.uint8)])
    file = io.BytesIO()
    Image.fromarray(rgba).save(file, "PNG", icc_profile=matrix_profile())
    np.testing.assert_array_equal(read_texture(file.getvalue()), srgb)
