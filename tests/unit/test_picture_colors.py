"""Colors of pictures: profiles, opacity, 16 bits, orientation, and what gets a note."""

import io
import struct
import zlib
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image, ImageCms, ImageOps

from filter_service.color_encoding import encoding_of_icc, srgb_curve
from filter_service.image_files import (
    read_color,
    read_color_file,
    read_depth_file,
)
from filter_service.pictures import read_picture_srgb8
from tests.unit.image_bytes import (
    GRAY,
    GRAY_ALPHA,
    P3_COLUMNS,
    RGB,
    RGBA,
    SRGB_PARA,
    gamma,
    icc,
    matrix_profile,
    named,
    png,
    table_profile,
)

HEIGHT_PX, WIDTH_PX = 9, 13


@pytest.fixture
def srgb(rng):
    return rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)


@pytest.fixture
def deep(rng):
    return rng.integers(0, 65536, (HEIGHT_PX, WIDTH_PX, 4)).astype(np.uint16)


def linear_of(codes, top):
    """Decode sRGB by IEC 61966-2-1."""
    value = codes / top
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb8_of(light):
    light = np.clip(light, 0.0, 1.0)
    curve = 1.055 * light ** (1.0 / 2.4) - 0.055
    return np.round(255.0 * np.where(light <= 0.0031308, 12.92 * light, curve))


def noted(path, said):
    """Read a picture of color; return its pixels, and check its only note."""
    found = read_color_file(path)
    (note,) = found.notes
    assert said in note
    assert note.startswith(f"'{path.name}': ")
    with pytest.warns(UserWarning, match="'"):
        read_color(path)
    return found.pixels


# --- opacity and 16 bits --------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "channels"), [(GRAY, 1), (RGB, 3), (GRAY_ALPHA, 2), (RGBA, 4)]
)
def test_16_bits_are_kept(tmp_path, deep, kind, channels):
    codes = deep[..., :channels].copy()
    if kind in (GRAY_ALPHA, RGBA):
        codes[..., -1] = 65535
    pixels = read_color(png(tmp_path / "a.png", codes, kind))
    colors = codes[..., :3] if channels > 2 else np.repeat(codes[..., :1], 3, axis=2)
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels, linear_of(colors, 65535.0), rtol=1e-6)


@pytest.mark.parametrize("layout", ["rgb48be", "rgba64be", "gray16be"])
@pytest.mark.parametrize(
    "how", [{"flags": "+ildct"}, {"pred": "mixed"}, {"pred": "paeth"}]
)
def test_16_bits_of_a_png_of_ffmpeg(tmp_path, deep, layout, how):
    """Interlaced, and with every filter."""
    av = pytest.importorskip("av")
    channels = {"rgb48be": 3, "rgba64be": 4, "gray16be": 1}[layout]
    codes = np.ascontiguousarray(deep[..., :channels].squeeze())
    if channels == 4:
        codes[..., 3] = 65535
    encoder = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH_PX, HEIGHT_PX, layout
    encoder.time_base, encoder.options = Fraction(1, 10), how
    frame = av.VideoFrame.from_ndarray(codes, format=layout)
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    (tmp_path / "a.png").write_bytes(b"".join(map(bytes, packets)))
    colors = codes[..., :3] if channels > 1 else np.repeat(codes[..., None], 3, axis=2)
    found = read_color(tmp_path / "a.png")
    np.testing.assert_allclose(found, linear_of(colors, 65535.0), rtol=1e-6)


@pytest.mark.parametrize("kind", [GRAY_ALPHA, RGBA])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_transparent_pixels_are_over_black_in_linear_light(tmp_path, rng, kind, dtype):
    top = np.iinfo(dtype).max
    channels = 2 if kind == GRAY_ALPHA else 4
    codes = rng.integers(0, top + 1, (4, 10, channels)).astype(dtype)
    codes[..., -1] = top
    codes[0, :, -1] = 0
    codes[1, :, -1] = rng.integers(0, top, 10)
    pixels = noted(
        png(tmp_path / "a.png", codes, kind), "50 % of the pixels are transparent"
    )
    light = linear_of(codes[..., :-1], float(top)) * (codes[..., -1:] / float(top))
    light = np.broadcast_to(light, (4, 10, 3))
    if dtype == np.uint8:
        np.testing.assert_allclose(pixels, srgb8_of(light), atol=0.0)
    else:
        np.testing.assert_allclose(pixels, light, rtol=1e-5)
    assert not pixels[0].any()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("kind", [GRAY, RGB])
def test_a_color_that_means_transparent_is_black(tmp_path, rng, dtype, kind):
    """The chunk tRNS, whose color counts only if all its bits do."""
    channels = 3 if kind == RGB else 1
    codes = rng.integers(1, 200, (4, 10, channels)).astype(dtype) * dtype(1)
    key = np.array([7, 8, 9][:channels], dtype)
    codes[2:] = 201
    codes[1] = key
    data = struct.pack(f">{channels}H", *(int(value) for value in key))
    path = png(tmp_path / "a.png", codes, kind, (b"tRNS", data))
    pixels = noted(path, "25 % of the pixels are transparent")
    assert not pixels[1].any()
    assert pixels[2:].all()


def test_a_palette_with_transparent_colors(tmp_path):
    image = Image.fromarray(np.array([[0, 1, 2, 1]], np.uint8), "L").convert("P")
    image.putpalette([250, 0, 0, 0, 250, 0, 0, 0, 250])
    image.save(tmp_path / "a.png", transparency=bytes([255, 0, 255]))
    pixels = noted(tmp_path / "a.png", "50 % of the pixels are transparent")
    np.testing.assert_array_equal(
        pixels, [[[250, 0, 0], [0, 0, 0], [0, 0, 250], [0, 0, 0]]]
    )


def test_one_bit_is_black_and_white(tmp_path):
    Image.fromarray(np.array([[True, False]])).save(tmp_path / "a.png")
    np.testing.assert_array_equal(
        read_color(tmp_path / "a.png"), [[[255] * 3, [0] * 3]]
    )


def test_alpha_of_arrays(tmp_path, srgb):
    alpha = np.full(srgb.shape[:2], 255, np.uint8)
    alpha[0] = 0
    np.save(tmp_path / "a.npy", np.dstack([srgb, alpha]))
    assert not noted(tmp_path / "a.npy", "transparent")[0].any()
    linear = np.dstack([srgb / 255.0, alpha / 255.0])
    np.save(tmp_path / "a.npy", linear)
    with pytest.raises(ValueError, match="a fourth channel that is not 1; allowed"):
        read_color(tmp_path / "a.npy")
    linear[..., 3] = 1.0
    np.save(tmp_path / "a.npy", linear)
    np.testing.assert_allclose(read_color(tmp_path / "a.npy"), srgb / 255.0, rtol=1e-6)


# --- color profiles --------------------------------------------------------------


def test_the_green_of_a_phone_is_brighter_than_that_of_srgb(tmp_path):
    """By CSS Color 4: 1.0420 of 0.5776 of green light; red is below 0."""
    image = Image.new("RGB", (5, 4), (30, 200, 60))
    image.save(tmp_path / "a.png", icc_profile=matrix_profile())
    np.testing.assert_array_equal(read_color(tmp_path / "a.png")[2, 2], [0, 204, 13])


@pytest.mark.parametrize("curve", [SRGB_PARA, gamma(1.8), gamma(2.2)])
def test_a_profile_is_applied_as_littlecms_does(tmp_path, srgb, curve):
    profile = matrix_profile(curve=curve)
    image = Image.fromarray(srgb)
    image.save(tmp_path / "a.png", icc_profile=profile)
    expected = ImageCms.profileToProfile(
        image,
        ImageCms.ImageCmsProfile(io.BytesIO(profile)),
        ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
        outputMode="RGB",
    )
    found = read_color(tmp_path / "a.png").astype(int)
    assert np.abs(found - np.asarray(expected)).max() <= 1


def test_16_bits_with_a_profile_of_a_matrix(tmp_path, deep):
    """Linear light within and beyond sRGB, by the columns of the profile."""
    profile = zlib.compress(matrix_profile())
    path = png(tmp_path / "a.png", deep[..., :3], RGB, (b"iCCP", b"p\0\0" + profile))
    light = linear_of(deep[..., :3], 65535.0) @ np.array(P3_COLUMNS)
    # from XYZ of D50 to linear sRGB (Lindbloom)
    to_srgb = [
        [3.1338561, -1.6168667, -0.4906146],
        [-0.9787684, 1.9161415, 0.0334540],
        [0.0719453, -0.2289914, 1.4052427],
    ]
    found = read_color(path)
    np.testing.assert_allclose(found, light @ np.transpose(to_srgb), atol=2e-4)
    assert found.min() < -0.01


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_profile_of_srgb_changes_nothing(tmp_path, srgb, suffix):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image = Image.fromarray(srgb)
    image.save(tmp_path / f"with{suffix}", icc_profile=profile)
    image.save(tmp_path / f"without{suffix}")
    found, plain = (read_color(tmp_path / f"{n}{suffix}") for n in ("with", "without"))
    np.testing.assert_array_equal(found, plain)


def test_a_gray_profile_is_applied(tmp_path):
    gray = np.arange(256, dtype=np.uint8).reshape(16, 16)
    profile = icc(b"GRAY", {b"desc": named(b"gray"), b"kTRC": gamma(1.0)})
    Image.fromarray(gray).save(tmp_path / "a.png", icc_profile=profile)
    expected = srgb8_of(gray / 255.0)
    found = read_color(tmp_path / "a.png")
    np.testing.assert_array_equal(found, np.repeat(expected[..., None], 3, axis=2))


def test_a_jpeg_for_printing_is_converted_by_its_profile(tmp_path):
    """Full cyan, the first channel, has L* 50 in this profile: 119 in sRGB."""
    lightness = [100, 0] * 4 + [50, 0] * 4  # black, the last channel, has 0
    profile = table_profile(b"CMYK", lightness)
    assert encoding_of_icc(profile) is None
    how = {"icc_profile": profile, "quality": 100}
    for ink, expected in (
        ((255, 0, 0, 0), 119),
        ((0, 0, 0, 0), 255),
        ((0, 0, 0, 255), 0),
    ):
        Image.new("CMYK", (16, 16), ink).save(tmp_path / "a.jpg", **how)
        np.testing.assert_allclose(
            read_color(tmp_path / "a.jpg")[8, 8], expected, atol=2
        )


def test_cmyk_without_a_profile_gets_a_note(tmp_path):
    Image.new("CMYK", (16, 16), (255, 0, 0, 0)).save(tmp_path / "a.jpg")
    pixels = noted(tmp_path / "a.jpg", "CMYK without a color profile")
    np.testing.assert_allclose(pixels[8, 8], [0, 255, 255], atol=3)


def test_16_bits_with_a_profile_of_lookup_tables_are_refused(tmp_path, deep):
    profile = zlib.compress(table_profile(b"RGB ", [0] * 7 + [100]))
    path = png(tmp_path / "a.png", deep[..., :3], RGB, (b"iCCP", b"p\0\0" + profile))
    with pytest.raises(ValueError, match=r"--color .*16 bits.*allowed: 8 bits, or"):
        read_color(path)
    codes = (deep[..., :3] >> 8).astype(np.uint8)
    path = png(tmp_path / "a.png", codes, RGB, (b"iCCP", b"p\0\0" + profile))
    found = read_color(path)
    np.testing.assert_array_equal(found[..., 0], found[..., 1])


@pytest.mark.parametrize("profile", [bytes(2000), matrix_profile()[:200], b"x"])
def test_a_damaged_profile_gets_a_note(tmp_path, srgb, profile):
    Image.fromarray(srgb).save(tmp_path / "a.png", icc_profile=profile)
    pixels = noted(tmp_path / "a.png", "its color profile cannot be used")
    np.testing.assert_array_equal(pixels, srgb)


def test_a_profile_for_other_colors_gets_a_note(tmp_path, srgb):
    profile = table_profile(b"CMYK", [100] * 16)
    Image.fromarray(srgb).save(tmp_path / "a.png", icc_profile=profile)
    pixels = noted(tmp_path / "a.png", "it does not fit the image")
    np.testing.assert_array_equal(pixels, srgb)


def test_gama_and_chrm_of_a_png(tmp_path, srgb):
    usual = (b"gAMA", struct.pack(">L", 45455))
    np.testing.assert_array_equal(
        read_color(png(tmp_path / "a.png", srgb, RGB, usual)), srgb
    )
    linear = (b"gAMA", struct.pack(">L", 100000))
    found = read_color(png(tmp_path / "a.png", srgb, RGB, linear))
    np.testing.assert_array_equal(found, srgb8_of(srgb / 255.0))
    p3 = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    codes = np.full((2, 2, 3), (30, 200, 60), np.uint8)
    chrm = (b"cHRM", struct.pack(">8L", *p3))
    found = read_color(png(tmp_path / "a.png", codes, RGB, usual, chrm))
    np.testing.assert_array_equal(found[0, 0], [0, 204, 13])


def test_codes_of_a_png_take_precedence(tmp_path):
    codes = np.full((2, 2, 3), (30, 200, 60), np.uint8)
    p3 = (b"cICP", bytes([12, 13, 0, 1]))
    srgb_chunk = (b"sRGB", b"\0")
    found = read_color(png(tmp_path / "a.png", codes, RGB, p3, srgb_chunk))
    np.testing.assert_array_equal(found[0, 0], [0, 204, 13])
    pq = (b"cICP", bytes([9, 16, 0, 1]))
    white = np.full((2, 2, 3), 148, np.uint8)  # 58 %: 203 cd/m2
    found = noted(png(tmp_path / "a.png", white, RGB, pq), "PQ: 203 cd/m2 is white")
    np.testing.assert_allclose(found, 1.0, rtol=0.02)
    unknown = (b"cICP", bytes([99, 13, 0, 1]))
    noted(png(tmp_path / "a.png", codes, RGB, unknown), "unknown color codes 99 and 13")


def test_adobe_rgb_of_a_camera_by_its_exif(tmp_path):
    """DCF: no profile, but the interoperability index R03."""
    ifd = struct.pack("<H", 1) + struct.pack("<HHL4s", 1, 2, 4, b"R03\0") + bytes(4)
    exif_ifd = struct.pack("<HHHLL", 1, 0xA005, 4, 1, 44) + bytes(4)
    first = struct.pack("<HHHLL", 1, 0x8769, 4, 1, 26) + bytes(4)
    exif = b"Exif\0\0II*\0" + struct.pack("<L", 8) + first + exif_ifd + ifd
    how = {"quality": 100, "subsampling": 0}
    Image.new("RGB", (16, 16), (60, 200, 60)).save(tmp_path / "a.jpg", exif=exif, **how)
    found = read_color(tmp_path / "a.jpg")[8, 8].astype(int)
    # 0.5861 of green light is 201, and 1.0429 * 0.0414 - 0.0429 * 0.5861 of blue is 37
    np.testing.assert_allclose(found, [0, 201, 37], atol=2)


# --- orientation, pages, resolution ------------------------------------------------


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_pictures_are_turned_upright_as_pillow_does(rng, orientation, suffix):
    image = Image.fromarray(rng.integers(0, 256, (8, 16, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    file = io.BytesIO()
    image.save(
        file, {".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:]), exif=exif
    )
    with Image.open(io.BytesIO(file.getvalue())) as stored:
        stored.load()
        expected = np.asarray(ImageOps.exif_transpose(stored).convert("RGB"))
    found, notes = read_picture_srgb8(file.getvalue())
    np.testing.assert_array_equal(found, expected)
    assert not notes


def test_16_bits_are_turned_upright(tmp_path, deep):
    exif = (
        b"eXIf",
        b"II*\0" + struct.pack("<LHHHLL", 8, 1, 0x0112, 3, 1, 6) + bytes(4),
    )
    turned = np.rot90(deep[..., 0], -1)
    depth = read_depth_file(png(tmp_path / "a.png", deep[..., 0], GRAY, exif))
    expected = np.where(turned == 65535, 0, turned) * 0.001
    np.testing.assert_allclose(depth.pixels, expected, rtol=1e-6)
    color = read_color(png(tmp_path / "a.png", deep[..., :3], RGB, exif))
    np.testing.assert_allclose(
        color, linear_of(np.rot90(deep[..., :3], -1), 65535.0), rtol=1e-6
    )


def test_other_pages_and_frames_get_a_note(tmp_path, srgb):
    pages = [Image.fromarray(np.full((4, 5), k + 1.0, np.float32)) for k in range(2)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    depth = read_depth_file(tmp_path / "a.tif")
    assert "more than one page; the first is read" in depth.notes[0]
    np.testing.assert_array_equal(depth.pixels, 1.0)
    frames = [Image.fromarray(srgb), Image.fromarray(255 - srgb)]
    frames[0].save(tmp_path / "a.png", save_all=True, append_images=frames[1:])
    np.testing.assert_array_equal(noted(tmp_path / "a.png", "it is animated"), srgb)


def test_pixels_that_are_not_square_by_their_resolution_get_a_note(tmp_path, srgb):
    Image.fromarray(srgb).save(tmp_path / "a.png", dpi=(100, 200))
    noted(tmp_path / "a.png", "pixels 2 times as wide as high")
    Image.fromarray(srgb).save(tmp_path / "a.png", dpi=(300, 300))
    read_color(tmp_path / "a.png")


def test_curves_of_profiles():
    """Every type of a parametric curve, against the formulas of ICC.1, 10.18."""
    values = np.linspace(0.0, 1.0, 11)
    given = (2.0, 0.5, 0.5, 0.25, 0.2, 0.125, 0.0625)
    g, a, b, c, d, e, f = given
    bright = (a * values + b) ** g
    expected = {
        0: values**g,
        1: np.where(values >= -b / a, bright, 0.0),
        2: np.where(values >= -b / a, bright + c, c),
        3: np.where(values >= d, bright, c * values),
        4: np.where(values >= d, bright + e, c * values + f),
    }
    for kind, n in enumerate((1, 3, 4, 5, 7)):
        numbers = struct.pack(f">{n}l", *(round(65536 * v) for v in given[:n]))
        tag = b"para" + bytes(4) + struct.pack(">HH", kind, 0) + numbers
        encoding = encoding_of_icc(matrix_profile(curve=tag))
        found = encoding.curves[0](values)
        np.testing.assert_allclose(found, np.clip(expected[kind], 0.0, 1.0), atol=1e-4)
    np.testing.assert_allclose(srgb_curve(values), linear_of(values, 1.0), rtol=1e-12)
