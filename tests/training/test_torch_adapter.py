"""The transform of the examples for data sets of PyTorch."""

import multiprocessing

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader, Dataset

from filter_service import Camera, EyeFilter, FilterSettings
from tests.source_tree import ROOT

HEIGHT, WIDTH = 24, 32
SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront")


@pytest.fixture
def transform(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "adapters"))
    from ocufilter_torch import SeenThrough

    return SeenThrough(
        "myopia", vertical_fov_deg=10.0, distance_m=2.0, settings=SETTINGS
    )


@pytest.fixture
def color(rng):
    return rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def expected(color, depth_m=2.0):
    camera = Camera.from_fov(10.0, width_px=WIDTH, height_px=HEIGHT)
    depth_m = np.broadcast_to(np.float32(depth_m), (HEIGHT, WIDTH)).copy()
    with EyeFilter("myopia", camera, SETTINGS) as eye:
        return eye.filter(
            *(color, depth_m),
            pupil_diameter_mm=4.0,
            focus_dpt=0.0,
            whole=True,
            merge=False,
            bright_pixels=False,
        ).color


def difference(first, second):
    return np.abs(np.asarray(first, float) - np.asarray(second, float)).max()


def test_it_takes_arrays_and_pillows_pictures(transform, color):
    seen, wanted = transform(color), expected(color)
    assert (seen.shape, seen.dtype) == (color.shape, np.uint8)
    assert difference(seen, wanted) <= 1  # of rounding to bytes
    assert difference(wanted, color) > 50
    picture = transform(Image.fromarray(color))
    assert isinstance(picture, Image.Image)
    np.testing.assert_array_equal(np.asarray(picture), seen)
    depth_m = np.linspace(0.3, 2.0, HEIGHT)[:, None] + np.zeros(WIDTH)
    deep = transform((color, depth_m))
    assert difference(deep, expected(color, depth_m)) <= 1
    np.testing.assert_array_equal(transform(color), seen)


def test_it_takes_floats_as_srgb(transform, color):
    seen = transform(color.astype(np.float32) / 255.0)
    assert seen.dtype == np.float32
    assert difference(255.0 * seen, expected(color)) < 0.51 + 1e-2


def test_it_takes_gray_pictures(transform, color):
    gray = color[..., 0]
    seen = transform(gray)
    assert (seen.shape, seen.dtype) == (gray.shape, np.uint8)
    linear = decoded(expected(np.repeat(gray[..., None], 3, axis=2)) / 255.0)
    wanted = encoded(linear @ np.array([0.2126, 0.7152, 0.0722]))
    assert difference(seen, 255.0 * wanted) < 2.0  # both are rounded to bytes
    assert difference(seen, gray) > 50
    picture = transform(Image.fromarray(gray))
    assert picture.mode == "L"
    np.testing.assert_array_equal(np.asarray(picture), seen)
    np.testing.assert_array_equal(transform(gray[None, :, :, None])[0, :, :, 0], seen)
    batch = torch.from_numpy(gray)[None, None]
    np.testing.assert_array_equal(transform(batch)[0, 0].numpy(), seen)


def decoded(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def encoded(linear):
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def test_each_picture_may_have_an_eye_of_its_own(transform, color):
    eye = {"profile": "emmetropia", "focus_dpt": 0.5}
    own, usual = transform(color, **eye), transform(color)
    assert difference(own, usual) > 20
    eyes = {"profile": ["myopia", "emmetropia"], "focus_dpt": [0.0, 0.5]}
    both = transform(np.stack([color, color]), **eyes)
    np.testing.assert_array_equal(both, [usual, own])
    with pytest.raises(TypeError, match="unknown 'pupil'; expected one of: "):
        transform(color, pupil=3.0)
    with pytest.raises(ValueError, match=r"samples\[1\].focus_dpt: it is -1"):
        transform(np.stack([color, color]), focus_dpt=[0.0, -1.0])


def test_it_needs_no_settings(transform, color):
    usual = type(transform)("myopia", vertical_fov_deg=20.0, distance_m=2.0)
    assert usual(color).shape == color.shape


def test_gradients_of_black_pictures_are_finite(transform):
    color = torch.zeros(3, HEIGHT, WIDTH, requires_grad=True)
    transform(color).sum().backward()
    assert torch.isfinite(color.grad).all()
    assert color.grad.abs().sum() > 0.0


class Pictures(Dataset):
    def __init__(self, pictures, transform):
        self.pictures, self.transform = pictures, transform

    def __len__(self):
        return len(self.pictures)

    def __getitem__(self, index):
        return self.transform(self.pictures[index])


@pytest.mark.parametrize("n_workers", [0, 2])
def test_a_loader_gives_what_arrays_give(transform, rng, n_workers):
    arrays = rng.integers(0, 256, (6, HEIGHT, WIDTH, 3), dtype=np.uint8)
    pictures = torch.from_numpy(arrays.transpose(0, 3, 1, 2).copy())
    loader = DataLoader(Pictures(pictures, transform), 3, num_workers=n_workers)
    seen = torch.cat(list(loader))
    assert seen.dtype == torch.uint8
    wanted = np.stack([transform(array) for array in arrays])
    np.testing.assert_array_equal(seen.numpy().transpose(0, 2, 3, 1), wanted)


def test_it_goes_to_other_processes(transform, color):
    wanted = transform(color)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (found,) = pool.map(transform, [color])
    np.testing.assert_array_equal(found, wanted)
