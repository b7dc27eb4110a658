"""Files of images of many wavelengths: layouts, limits and damage."""

import errno
import os

import numpy as np
import pytest
from scipy import io

from estimator.bounded_files import InvalidFile
from filter_service import band_files
from filter_service.band_files import read_bands, write_bands

NM = np.array([400.0, 450.0, 500.0, 700.0])
BANDS = np.random.default_rng(0).random((5, 7, 4), np.float32)


@pytest.mark.parametrize("suffix", [".hdr", ".npy"])
def test_what_is_written_is_read(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_bands(path, BANDS, wavelengths_nm=NM)
    found = read_bands(path)
    assert np.array_equal(found.bands, BANDS)
    if suffix == ".hdr":
        assert np.array_equal(found.wavelengths_nm, NM)


def test_an_envi_header_never_describes_other_data(tmp_path, monkeypatch):
    path = tmp_path / "a.hdr"
    write_bands(path, BANDS)
    more, rename, seen = np.ones((5, 7, 6), np.float32), os.replace, []

    def replace_and_read(source, target):
        rename(source, target)
        seen.append(read_bands(path).bands.shape if path.exists() else None)

    monkeypatch.setattr(os, "replace", replace_and_read)
    write_bands(path, more)
    assert seen == [None, more.shape]


@pytest.mark.parametrize("suffix", [".hdr", ".npy"])
def test_a_full_disk_keeps_the_earlier_files(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"a{suffix}"
    write_bands(path, BANDS)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def fail(_descriptor):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        write_bands(path, np.ones((5, 7, 6), np.float32))
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("interleave", "axes"), [("bsq", (2, 0, 1)), ("bil", (0, 2, 1)), ("bip", (0, 1, 2))]
)
@pytest.mark.parametrize(("order", "number"), [("<", 0), (">", 1)])
def test_layouts_of_envi(tmp_path, interleave, axes, order, number):
    values = np.arange(BANDS.size).reshape(BANDS.shape)
    raw = values.transpose(axes).astype(f"{order}u2").tobytes()
    (tmp_path / "a.img").write_bytes(b"12345" + raw)
    (tmp_path / "a.hdr").write_text(
        "ENVI\ndescription = {a = 1,\n two lines}\nsamples = 7\nlines = 5\nbands = 4\n"
        f"header offset = 5\ndata type = 12\ninterleave = {interleave}\n"
        f"byte order = {number}\nwavelength = {{0.4, 0.45,\n 0.5, 0.7}}\n"
    )
    found = read_bands(tmp_path / "a.hdr")
    assert np.array_equal(found.bands, values)
    np.testing.assert_allclose(found.wavelengths_nm, NM)


@pytest.mark.parametrize("is_compressed", [False, True])
def test_files_of_matlab(tmp_path, is_compressed):
    path = tmp_path / "a.mat"
    content = {"cube": BANDS, "wavelengths": NM, "note": "text"}
    io.savemat(path, content, do_compression=is_compressed)
    found = read_bands(path)
    assert np.array_equal(found.bands, BANDS)
    assert np.array_equal(found.wavelengths_nm, NM)


def test_a_compressed_file_that_expands_beyond_the_limit_is_refused(
    tmp_path, monkeypatch
):
    path = tmp_path / "a.mat"
    zeros = np.zeros((100, 100, 100), np.float32)
    io.savemat(path, {"cube": zeros}, do_compression=True)
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(band_files, "MAX_DECODED_BYTES", 1_000_000)
    with pytest.raises(InvalidFile, match="more than"):
        read_bands(path)


GOOD = {
    "samples": "7",
    "lines": "5",
    "bands": "4",
    "data type": "4",
    "interleave": "bip",
    "byte order": "0",
}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"samples": "-7"}, "'samples' is '-7'"),
        ({"lines": "99999999999"}, "9 digits"),
        ({"samples": "999999", "lines": "999999"}, "at most 402,653,184"),
        ({"data type": "6"}, "'data type' is '6'"),
        ({"interleave": "tiled"}, "bsq, bil, bip"),
        ({"bands": "5"}, "700 bytes"),
        ({"wavelength": "{400, 500}"}, "2 wavelengths; allowed: 4"),
        ({"wavelength": "{a, b, c, d}"}, "'wavelength' is"),
    ],
)
def test_damaged_headers_are_named(tmp_path, changes, named):
    write_bands(tmp_path / "a.hdr", BANDS)
    lines = [f"{name} = {value}" for name, value in (GOOD | changes).items()]
    (tmp_path / "a.hdr").write_text("\n".join(["ENVI", *lines]))
    with pytest.raises(InvalidFile, match=named):
        read_bands(tmp_path / "a.hdr", option="bands")


def test_files_of_other_kinds_are_named(tmp_path):
    (tmp_path / "a.hdr").write_text("no header")
    (tmp_path / "b.hdr").write_text(
        "\n".join(["ENVI", *(f"{k} = {v}" for k, v in GOOD.items())])
    )
    np.save(tmp_path / "flat.npy", BANDS[..., 0])
    (tmp_path / "damaged.mat").write_bytes(b"MATLAB 5.0" + bytes(200))
    io.savemat(tmp_path / "two.mat", {"a": BANDS, "b": BANDS})
    for name, named in (
        ("a.hdr", "not an ENVI header"),
        ("b.hdr", "values is missing"),
        ("flat.npy", r"shape \(5, 7\)"),
        ("damaged.mat", "0 arrays|cannot be read"),
        ("two.mat", "2 arrays"),
        ("a.tif", "not a kind of band image"),
    ):
        with pytest.raises(InvalidFile, match=named):
            read_bands(tmp_path / name)
